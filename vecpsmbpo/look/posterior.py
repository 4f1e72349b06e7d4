"""The posterior over policies as a picture: how likely each member was to act, which one did, and what it earned.

Figures 9 and 10 of the paper draw one line for each of 25 members; a row for each, shaded by its probability, can be
read as well where there are many.
"""

import itertools
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from vecpsmbpo.look import style
from vecpsmbpo.look.runs import Columns, Lane

Array = np.ndarray

NEEDED = {"episode": 1, "model": 1, "policy": 1, "return": 1, "random": 1, "probs": 2}  # columns, and their axes
BINS = 240  # most columns: with more episodes each stands for several
# From nothing to blue: it can be laid on white and on black paper.
SHADES = LinearSegmentedColormap.from_list("shades", [(0.0, 0.447, 0.698, 0.0), (0.0, 0.447, 0.698, 1.0)])


def lacking(episodes: Columns) -> list[str]:
    """The columns that a picture needs and a log with episodes has not, or not as such numbers."""
    if not episodes:
        return []
    shapes = {name: np.ndim(episodes.get(name, 0)) for name in NEEDED}
    return [
        name
        for name, axes in NEEDED.items()
        if shapes[name] != axes or (name in ("episode", "probs") and not np.isfinite(episodes[name]).all())
    ]


def acting(episodes: Columns, n_policies: int) -> Array:
    """[E], n·M + m of the member that acted; -1 for random episodes and where all members act together."""
    members = episodes["model"] * n_policies + episodes["policy"]
    return np.where((episodes["random"] > 0) | np.isnan(members), -1, members).astype(int)


def binned(values: Array, edges: Array) -> Array:
    """Means of the rows [E, ...] between edges: [B, ...]."""
    sums = np.add.reduceat(values, edges[:-1], axis=0)
    return sums / np.diff(edges).reshape(-1, *[1] * (values.ndim - 1))


def edges(count: int) -> Array:
    """Where bins of nearly equal size begin, and the end: [B + 1]."""
    return np.unique(np.linspace(0, count, min(count, BINS) + 1).astype(int))


def names(n_models: int, n_policies: int, members: int) -> list[str]:
    """Of the members: `n, m`, or `m` where policies belong to no model."""
    if members != n_models * n_policies:
        return [str(m) for m in range(members)]
    return [f"{n}, {m}" for n in range(n_models) for m in range(n_policies)]


def draw(lane: Lane) -> Figure:
    """The picture of one lane; it has episodes."""
    figure = Figure(figsize=(4.4, 4.6), layout="constrained")
    weights, returns = figure.subplots(2, 1, sharex=True, height_ratios=(1.35, 1))
    draw_weights(weights, lane)
    _draw_returns(returns, lane.episodes, acting(lane.episodes, lane.run.settings.policies_per_model))
    return figure


def draw_weights(axes: Axes, lane: Lane, x: str = "episode", until: float = np.inf) -> None:
    """A row for each member, shaded by its probability; a dot for the one that acted, where there is room for dots.

    Args:
        x: the column that is drawn over, `episode` or `env_steps` (at an episode's end).
        until: the largest x.
    """
    settings = lane.run.settings
    there = lane.episodes[x] <= until
    episodes = {name: column[there] for name, column in lane.episodes.items()}
    acts, between = acting(episodes, settings.policies_per_model), edges(len(episodes[x]))
    before = np.concatenate([[0.0], episodes[x]])  # an episode reaches from the end of the one before it to its own
    ends, probs = before[between], binned(episodes["probs"], between)
    rows = np.arange(probs.shape[1] + 1) - 0.5
    strongest = max(float(probs.max()), 2 / probs.shape[1])  # so that nothing but equal chances is half as strong
    mesh = axes.pcolormesh(ends, rows, probs.T, cmap=SHADES, vmin=0, vmax=strongest, rasterized=True)
    title = "probability to act"
    if len(acts) == len(probs):
        centres = (ends[:-1] + ends[1:]) / 2
        look: dict[str, Any] = {"color": style.COLOURS[1], "lw": 0.6, "edgecolors": style.PAPER, "zorder": 3}
        axes.scatter(centres[acts >= 0], acts[acts >= 0], s=np.clip(3000 / len(acts), 8, 26), **look)
        title = "probability to act, and who did (dots)"
    axes.set_title(title, fontweight="normal", fontsize=9)
    axes.grid(False)
    axes.invert_yaxis()
    labels = names(settings.n_models, settings.policies_per_model, probs.shape[1])
    shown = range(0, len(labels), -(-len(labels) // 12))
    axes.set_yticks(list(shown), [labels[index] for index in shown])
    axes.set_ylabel("member n, m" if "," in labels[0] else "member m")
    bar = axes.figure.colorbar(mesh, ax=axes, pad=0.02, fraction=0.05)
    bar.outline.set_visible(False)
    bar.ax.yaxis.set_major_locator(MaxNLocator(4))


def _draw_returns(axes: Axes, episodes: Columns, acts: Array) -> None:
    """What every episode earned, hollow where no member is credited with it; of many episodes how they are spread."""
    index, earned, credited = episodes["episode"], episodes["return"], acts >= 0
    if len(index) > 4 * BINS:
        _draw_bands(axes, index, earned)
    else:
        dots: dict[str, Any] = {"s": 14, "clip_on": False}  # the last episode's lies on the edge
        alone: dict[str, Any] = {"facecolors": "none", "edgecolors": style.FAINT, "lw": 0.7}
        axes.scatter(index[~credited], earned[~credited], label="random, or by all", **dots, **alone)
        axes.scatter(index[credited], earned[credited], label="by a member", color=style.COLOURS[1], lw=0, **dots)
    axes.set_xlabel("episode")
    axes.set_ylabel("return")
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    # Above, and not among the dots.
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0.2, ncols=3, handletextpad=0.4)


def _draw_bands(axes: Axes, index: Array, earned: Array) -> None:
    """Bands of the middle half and of the middle nine tenths of the returns in each bin, and their median."""
    between = edges(len(index))
    parts = [earned[begin:end] for begin, end in itertools.pairwise(between)]
    lowest, low, middle, high, highest = np.transpose([np.nanquantile(x, (0.05, 0.25, 0.5, 0.75, 0.95)) for x in parts])
    centres = np.array([index[begin:end].mean() for begin, end in itertools.pairwise(between)])
    axes.fill_between(centres, lowest, highest, color=style.COLOURS[1], alpha=0.15, lw=0, label="nine tenths")
    axes.fill_between(centres, low, high, color=style.COLOURS[1], alpha=0.3, lw=0, label="half")
    axes.plot(centres, middle, color=style.COLOURS[1], lw=1.2, label="median")
