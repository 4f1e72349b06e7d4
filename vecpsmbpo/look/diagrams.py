"""What `vecpsmbpo diagnose` measured, as pictures: each has its caption, and is one of a page or of a sheet."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from vecpsmbpo.look import style

Array = np.ndarray

COLUMNS = 3  # pictures in a row of a sheet
PANEL = (4.4, 3.2)
GREY: Any = {"color": style.FAINT, "lw": 1.2}
TREND = 3  # checkpoints that it takes at least to show how something changes over training


class Panel(NamedTuple):
    """Attributes:
    title: of the picture on a sheet.
    caption: what is to be seen, in a page.
    draw: on axes.
    """

    title: str
    caption: str
    draw: Callable[[Axes], None]


def write(diagnosis: dict[str, Any], path: Path) -> None:
    """All panels on one sheet.

    Raises:
        SettingError: it cannot be written.
    """
    found = list(panels(diagnosis))
    with style.styled():
        figure, axes = style.grid(max(len(found), 1), COLUMNS, PANEL)
        for axis, panel in zip(axes, found, strict=False):
            panel.draw(axis)
            axis.set_title(panel.title)
        figure.suptitle(headline(diagnosis), x=0.01, ha="left", fontsize=10)
        style.save(figure, path)


def figures(diagnosis: dict[str, Any]) -> Iterator[tuple[Figure, str]]:
    """Each panel by itself, and its caption."""
    for panel in panels(diagnosis):
        figure, (axes,) = style.grid(1, 1, PANEL)
        panel.draw(axes)
        yield figure, panel.caption


def headline(diagnosis: dict[str, Any]) -> str:
    """What was measured, in a line."""
    lane = ", ".join(f"{name} {value:g}" for name, value in diagnosis["lane"].items())
    count = diagnosis["episodes"]
    fresh = f"{count} fresh episode{'s' if count > 1 else ''} of each member"
    return f"{diagnosis['task']}, {lane}, step {diagnosis['env_steps']:,}: {fresh}"


def panels(diagnosis: dict[str, Any]) -> Iterator[Panel]:
    """Those that there is something for."""
    if models := diagnosis["models"]:
        yield from _model_panels(models)
    if critics := diagnosis["critics"]:
        yield _critic_panel(critics)
    if len(diagnosis["history"]) >= TREND:
        yield from _history_panels(diagnosis["history"])
    if states := diagnosis["states"]:
        yield _states_panel(states)


# ── models ────────────────────────────────────────────────────────────────────────────────────────────────────────


def _model_panels(models: dict[str, Any]) -> Iterator[Panel]:
    relative = {name: _array(values) for name, values in models["relative"].items()}
    reward = {name: _array(models[name])[..., -1] for name in relative}
    yield Panel(
        "error against horizon",
        "how far each model is from what really happened under the same actions, so many steps ahead: root mean square "
        "in standard deviations of the observations, beside the deviation that it expected itself; the models from one "
        "another; and what knows nothing, that nothing changes",
        lambda axes: _draw_errors(axes, relative, "error, in standard deviations"),
    )
    yield Panel(
        "error of the reward",
        "the same of the reward of each step, in its own unit",
        lambda axes: _draw_errors(axes, reward, "error of the reward"),
    )
    yield Panel(
        "error by dimension",
        "the error of every coordinate of the observation and of the reward, in its standard deviations (darkest: one "
        "or more, if any is); mean over models",
        lambda axes: _draw_dimensions(axes, models, "error"),
    )
    yield Panel(
        "error by dimension, as expected",
        "the error that the models themselves expected of the same, in the same colours: lighter where they are too "
        "sure, darker where they are not sure enough",
        lambda axes: _draw_dimensions(axes, models, "expected"),
    )
    cells = zip(models["levels"], _array(models["coverage"]).mean(axis=(0, 2)), strict=True)
    shares = ", ".join(f"{100 * share:.0f}% within their {100 * level:.0f}% intervals" for level, share in cells)
    yield Panel(
        "calibration, one step ahead",
        f"where what really happened lies in the distribution that a model predicted for it (probability integral "
        f"transform, all dimensions): even for a model that is right, high at both ends for one that is too sure; "
        f"{shares}",
        lambda axes: _draw_calibration(axes, models),
    )
    if reliability := models.get("reliability"):  # diagnoses of before have none
        yield Panel(
            "errors made against expected",
            "one step ahead, predictions grouped by the error that the model expected of them, tenths and the last "
            "tenth finer (all dimensions, each in its standard deviations; root mean squares): on the line for a "
            "model that is right; below it rollouts are scattered more than the world is, above it less",
            lambda axes: _draw_reliability(axes, reliability),
        )


def _array(values: Any) -> Array:
    """None is not a number."""
    return np.array(values, float)


def _draw_errors(axes: Axes, found: dict[str, Array], label: str) -> None:
    steps = np.arange(1, found["error"].shape[1] + 1)
    for index, look in enumerate(style.looks(len(found["error"]))):
        axes.plot(steps, found["error"][index], color=look.colour, label=f"model {index}")
        axes.plot(steps, found["expected"][index], color=look.colour, ls="--", lw=1)
    axes.plot([], [], ls="--", lw=1, color=style.INK, label="as expected by it")
    if np.isfinite(found["disagreement"]).any():
        axes.plot(steps, found["disagreement"], color=style.INK, ls=":", label="between models")
    axes.plot(steps, found["no_change"], label="nothing changes", **GREY)
    known = np.concatenate([values[np.isfinite(values) & (values > 0)] for values in map(np.ravel, found.values())])
    if len(known):
        axes.set_yscale("log")
        most = 30 * np.nanmax(np.where(np.isfinite(found["no_change"]), found["no_change"], 0))
        axes.set_ylim(top=min(2 * known.max(), max(most, 10 * known.min())))  # models that run away leave the picture
    axes.set_xlabel("steps ahead")
    axes.set_ylabel(label)
    axes.legend(fontsize=7, ncols=2)


def _draw_dimensions(axes: Axes, models: dict[str, Any], which: str) -> None:
    """`which`, `error` or `expected`, in colours that are the same for both."""
    std = _array(models["spread"])
    unit = np.where(std > 0, std, np.nan)
    both = {name: _array(models[name]).mean(axis=0) / unit for name in ("error", "expected")}
    errors, names = both[which], models["dimensions"]
    known = np.concatenate([values[np.isfinite(values) & (values > 0)] for values in both.values()])
    most = min(1.0, known.max(initial=1e-2))  # beyond a standard deviation a model knows nothing
    scale = LogNorm(min(max(known.min(initial=most), 1e-3 * most), 0.5 * most), most, clip=True)
    edges = np.arange(errors.shape[0] + 1) + 0.5
    rows = np.arange(len(names) + 1) - 0.5
    mesh = axes.pcolormesh(edges, rows, errors.T, cmap="viridis_r", norm=scale, rasterized=True)
    shown = [*range(0, len(names) - 1, -(-len(names) // 14)), len(names) - 1]
    axes.set_yticks(shown, [names[index] for index in shown])
    axes.invert_yaxis()
    axes.grid(False)
    axes.set_xlabel("steps ahead")
    bar = axes.figure.colorbar(mesh, ax=axes, pad=0.02, fraction=0.05)
    bar.set_label(f"{'error' if which == 'error' else 'expected error'}, in standard deviations")
    bar.outline.set_visible(False)


def _draw_calibration(axes: Axes, models: dict[str, Any]) -> None:
    histogram = _array(models["histogram"])
    edges = np.linspace(0, 1, histogram.shape[1] + 1)
    for index, look in enumerate(style.looks(len(histogram))):
        axes.stairs(histogram[index], edges, color=look.colour, lw=1.4, label=f"model {index}")
    axes.axhline(1, label="were it right", **GREY)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("place in the predicted distribution")
    axes.set_ylabel("density of what happened")
    axes.legend(fontsize=7, ncols=2)


def _draw_reliability(axes: Axes, reliability: dict[str, Any]) -> None:
    expected, made = (_array(reliability[name]) for name in ("expected", "made"))
    for index, look in enumerate(style.looks(len(expected))):
        axes.plot(expected[index], made[index], "o-", ms=3, lw=1, color=look.colour, label=f"model {index}")
    known = np.concatenate([expected.ravel(), made.ravel()])
    known = known[np.isfinite(known) & (known > 0)]
    if len(known):
        axes.set_xscale("log")
        axes.set_yscale("log")
        ends = [known.min(), known.max()]
        axes.plot(ends, ends, label="were it right", **GREY)
    axes.set_xlabel("error expected, in standard deviations")
    axes.set_ylabel("error made")
    axes.legend(fontsize=7, ncols=2)


# ── critics, training, states ─────────────────────────────────────────────────────────────────────────────────────


def _critic_panel(critics: dict[str, Any]) -> Panel:
    caption = (
        f"what critics promised, min(Q₁, Q₂), and what was earned from the same states on, discounted by "
        f"{critics['discount']:g} and with the entropy bonus: Q is {critics['q']:.4g}, the return "
        f"{critics['earned']:.4g}, on average over {critics['states']:,} states (the difference "
        f"{critics['bias']:+.3g} ± {critics['spread_of_bias']:.3g}); a colour for each member"
    )
    return Panel("Q against the return", caption, lambda axes: _draw_critics(axes, critics))


def _draw_critics(axes: Axes, critics: dict[str, Any]) -> None:
    shown = {name: _array(values) for name, values in critics["shown"].items()}
    names = critics["members"]
    for index, look in enumerate(style.looks(len(names), ordered=len(names) > len(style.COLOURS))):
        here = shown["member"] == index
        dots: dict[str, Any] = {"s": 7, "lw": 0, "alpha": 0.6, "rasterized": True}
        axes.scatter(shown["earned"][here], shown["q"][here], color=look.colour, label=names[index], **dots)
    ends = [np.nanmin([shown["earned"], shown["q"]]), np.nanmax([shown["earned"], shown["q"]])]
    axes.plot(ends, ends, label="equal", **GREY)
    axes.set_xlabel("return really earned")
    axes.set_ylabel("Q")
    if len(names) <= 6:
        axes.legend(fontsize=7, ncols=2, markerscale=2)


def _history_panels(history: list[dict[str, Any]]) -> Iterator[Panel]:
    seen = [point for point in history if point["critics"]]
    if len(seen) >= TREND:
        yield Panel(
            "Q over training",
            "the same at every checkpoint that is kept: mean Q, and mean return from the same states on",
            lambda axes: _draw_bias(axes, seen),
        )
    fitted = [point for point in history if point["errors"]]
    if len(fitted) >= TREND:
        yield Panel(
            "model error over training",
            "the models' error one step ahead and farthest ahead, at every checkpoint that is kept; mean over models",
            lambda axes: _draw_model_errors(axes, fitted),
        )


def _draw_bias(axes: Axes, seen: list[dict[str, Any]]) -> None:
    steps = [point["env_steps"] for point in seen]
    q, earned, std = (_array([p["critics"][name] for p in seen]) for name in ("q", "earned", "spread_of_bias"))
    looks = style.looks(2)
    style.line(axes, looks[0], np.array(steps), q, low=q - std, high=q + std, label="Q (± s.d. of its error)")
    style.line(axes, looks[1], np.array(steps), earned, label="return really earned")
    style.steps_axis(axes, "environment steps")
    axes.legend(fontsize=7)


def _draw_model_errors(axes: Axes, fitted: list[dict[str, Any]]) -> None:
    steps, found = np.array([p["env_steps"] for p in fitted]), _array([p["errors"] for p in fitted])
    for look, values, name in zip(style.looks(2), found.T, ("one step ahead", "farthest ahead"), strict=True):
        style.line(axes, look, steps, values, label=name)
    axes.set_yscale("log")
    style.steps_axis(axes, "environment steps")
    axes.set_ylabel("error, in standard deviations")
    axes.legend(fontsize=7)


def _states_panel(states: dict[str, Any]) -> Panel:
    distance = states["distance"]
    caption = (
        f"states of real data and imagined ones that policies learn from now ({states['method']}); the median distance "
        f"to the nearest real state is {_number(distance['imagined'])} standard deviations for imagined states, and "
        f"{_number(distance['fresh'])} for those of the fresh episodes"
    )
    return Panel("imagined among real states", caption, lambda axes: _draw_states(axes, states))


def _draw_states(axes: Axes, states: dict[str, Any]) -> None:
    dots: dict[str, Any] = {"s": 5, "lw": 0, "rasterized": True}
    for look, name in zip(style.looks(2), ("real", "imagined"), strict=True):
        x, y = _array(states[name]).T
        axes.scatter(x, y, color=look.colour, alpha=0.45, label=name, **dots)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(states["method"])
    axes.legend(fontsize=7, markerscale=2)


def _number(value: float | None) -> str:
    return "unbounded" if value is None else f"{value:.3g}"
