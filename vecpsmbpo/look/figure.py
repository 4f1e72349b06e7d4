"""`vecpsmbpo figure`: a figure of the paper, or its table, from the runs of its experiment."""

import functools
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console
from rich.progress import track

from vecpsmbpo import arguments, config, logged
from vecpsmbpo.look import compare, experiments, files, groups, published, states
from vecpsmbpo.look.curves import Curve, curve, error_band, joined
from vecpsmbpo.look.experiments import Experiment
from vecpsmbpo.look.groups import Group
from vecpsmbpo.look.runs import Lane
from vecpsmbpo.settings import SettingError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = np.ndarray

PICTURES, TABLES = (".png", ".svg", ".pdf"), (".md", ".txt")
OPTIONS = {
    "size": arguments.choice("of the runs, where they are of several", *config.options("size"), default=""),
    "runs": arguments.out("where the runs are", "runs"),
    "out": arguments.out(
        "the picture, by default named after the figure; of table1 the table, by default on the screen",
        "",
        *PICTURES,
        *TABLES,
    ),
}
LAST = 10  # evaluations that figure 7 averages
STAGES = 3  # of training, in figures 8, 18 and 19
INITIAL = 1 / 3  # of training, which figures 9 and 10 show by itself (40K of 125K steps, 100K of 300K)
DRAWINGS = ("fig1", "fig3", "fig14")  # the paper's own; nothing is run for them
# Table 1's lines.
TABLE_1 = (
    "total_steps", "episode_length", "n_models", "n_policies", "model_weight_decay", "model_update_every",
    "rollout_starts", "horizon_first", "horizon_last", "horizon_ramp_start", "horizon_ramp_end", "target_entropy",
    "real_ratio", "updates_per_step", "temperature",
)  # fmt: skip


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, there are no runs, or the file cannot be written.
    """
    suffixes = TABLES if "table1" in words else PICTURES
    out_option = arguments.out(OPTIONS["out"].what, "", *suffixes)
    named, values = arguments.parse("figure", words, OPTIONS | {"out": out_option})
    if len(named) != 1 or named[0] not in DRAW:
        what = f"{named[0]} is a drawing and is left out" if named and named[0] in DRAWINGS else "takes the name of one"
        raise SettingError(f"figure: {what}; one of {', '.join(DRAW)}")
    (name,) = named
    experiment = experiments.load(name, values["runs"], values["size"])
    out = values["out"] or (None if name == "table1" else Path(f"{name}.png"))
    if out is not None:
        files.check_writable(out)
    if DRAW[name] is draw_states:
        states.check_umap()
    for text in experiment.warnings():
        print(f"vecpsmbpo: warning: {text}", file=sys.stderr)
    _write(experiment, out)
    return 0


def _write(experiment: Experiment, out: Path | None) -> None:
    """Draws the figure into `out`; the table may also be printed (None)."""
    drawn = DRAW[experiment.name]
    if drawn is table_1:
        if out is None:
            print(table_1(experiment), end="")
            return
        files.write_text(out, table_1(experiment))
    else:
        from vecpsmbpo.look import style  # here, not above: mistakes answer before matplotlib is imported

        assert out is not None, "only the table is printed"
        with style.styled():
            style.save(drawn(experiment), out)
    print(f"written: {out}")


Panel = tuple["Axes", str, list[Group]]  # with its task, and what is drawn of it


def _panels(
    experiment: Experiment, by: Sequence[str] = (), extra: int = 0
) -> tuple["Figure", list[Panel], list["Axes"]]:
    """A figure with a panel for every task, in groups `by` (`groups.group`), and `extra` ones after them."""
    from vecpsmbpo.look import style

    tasks = list(experiment.tasks(by))
    count = len(tasks) + extra
    figure, axes = style.grid(count, 2 if count == 4 else 3, (4.4, 3.0))
    figure.suptitle(_note(experiment), x=0.01, ha="left", fontsize=9)
    for axis, (task, _) in zip(axes, tasks, strict=False):
        axis.set_title(task)
        axis.set_ylabel(logged.of("eval_return").label)
        style.steps_axis(axis, logged.of("env_steps").label)
    return figure, [(axis, task, here) for axis, (task, here) in zip(axes, tasks, strict=False)], axes[len(tasks) :]


def _looks(panels: Sequence[Panel]) -> dict[str, Any]:
    """How each group is drawn, in whichever panels it is."""
    from vecpsmbpo.look import plot, style

    largest = max((here for _, _, here in panels), key=len)
    names = dict.fromkeys(one.name for here in (largest, *(here for _, _, here in panels)) for one in here)
    return style.looks_of(list(names), ordered=plot.is_ordered(largest))


def _curves(together: Sequence[Group], y: str = "eval_return") -> list[Curve]:
    return [curve(one, "env_steps", y, band=error_band) for one in together]


def _note(experiment: Experiment) -> str:
    """What was averaged, and that it is not the paper's own figure."""
    seeds = {len(one.lanes) for _, here in experiment.tasks() for one in here}
    of = f"{min(seeds)} to {max(seeds)} seeds" if len(seeds) > 1 else f"{max(seeds)} seed{'s' * (max(seeds) > 1)}"
    return f"experiment={experiment.name} size={experiment.size}: mean of {of}, band: standard error"


def draw_curves(experiment: Experiment, *, reference: str = "") -> "Figure":
    """Learning curves of every task: figures 4, 5, 11, 12, 15, 16 and 17.

    Args:
        reference: `sac` draws the asymptotic line of figure 4, `mbpo` the MBPO* of figure 15, where they are known.
    """
    from vecpsmbpo.look import plot, style

    known: dict[str, Callable[[str], Any]] = {"sac": published.asymptote, "mbpo": published.mbpo}
    figure, panels, _ = _panels(experiment)
    looks = _looks(panels)
    for axis, task, here in panels:
        plot.draw_curves(axis, _curves(here), looks)
        if reference and task in published.SAC_3M:
            plot.draw_references(axis, {reference: known[reference](task)})
    style.legend(figure, max((axis for axis, *_ in panels), key=_named), columns=6)
    return figure


def _named(axis: "Axes") -> int:
    """How much of it the legend would name."""
    return len(axis.get_legend_handles_labels()[1])


def regret(lane: Lane, best: float) -> tuple[Array, Array]:
    """When the lane's episodes ended, and the regret accumulated until then: Σ (best - return), [E] each."""
    return lane.episodes["env_steps"], np.cumsum(best - lane.episodes["return"])


def draw_regret(experiment: Experiment) -> "Figure":
    """Figure 2: cumulative regret for each λ."""
    from vecpsmbpo.look import plot, style

    figure, panels, _ = _panels(experiment)
    for axis, _, here in panels:
        scale = published.scale(here[0].lanes[0].run.settings)
        assert scale, "figure 2 is of a task whose rewards are bounded"
        lines = [[regret(lane, scale[1]) for lane in one.lanes] for one in here]
        curves = [joined(one, line, "env_steps", band=error_band) for one, line in zip(here, lines, strict=True)]
        plot.draw_curves(axis, curves, _looks(panels))
        axis.set_ylabel("cumulative regret")
    style.legend(figure, panels[0][0], columns=3)
    return figure


def draw_averages(experiment: Experiment) -> "Figure":
    """Figure 6: a policy sampled for each episode (solid) against the average of all (dashed), by M."""
    from vecpsmbpo.look import style

    figure, panels, _ = _panels(experiment, ["n_policies", "posterior"])
    sizes = sorted({run.settings.policies_per_model for run in experiment.runs})
    looks = dict(zip(sizes, style.looks(len(sizes)), strict=True))
    for axis, _, here in panels:
        for one, line in zip(here, _curves(here), strict=True):
            m, average = one.values["n_policies"], one.values["posterior"] == "average"
            look = looks[m]._replace(dashes="--" if average else "-")
            name = f"M = {m}, {'average' if average else 'sampled'}"
            style.line(axis, look, line.x, line.y, low=line.low, high=line.high, label=name)
    style.legend(figure, max((axis for axis, *_ in panels), key=_named), columns=3)
    return figure


def last_evaluations(lane: Lane) -> float:
    """Mean of a lane's last ten evaluations."""
    return float(np.nanmean(lane.epochs["eval_return"][-LAST:]))


def draw_bars(experiment: Experiment) -> "Figure":
    """Figure 7: the last ten evaluations for every N and M."""
    from vecpsmbpo.look import style

    figure, panels, _ = _panels(experiment, ["n_policies", "n_models"])
    sizes = sorted({run.settings.policies_per_model for run in experiment.runs})
    width = 0.8 / len(sizes)
    for axis, task, here in panels:
        for index, (m, look) in enumerate(zip(sizes, style.looks(len(sizes), ordered=True), strict=True)):
            cells = [one for one in here if one.values["n_policies"] == m]
            scores = [np.array([last_evaluations(lane) for lane in one.lanes]) for one in cells]
            errors = [np.std(x, ddof=1) / np.sqrt(len(x)) if len(x) > 1 else 0.0 for x in scores]
            at = [one.values["n_models"] + (index - (len(sizes) - 1) / 2) * width for one in cells]
            means = [np.mean(x) for x in scores]
            axis.bar(at, means, 0.92 * width, color=look.colour, yerr=errors, label=f"M = {m}", error_kw={"lw": 0.9})
        axis.set_title(f"{task}: last {LAST} evaluations")
        axis.set_xlabel("number of models N")
        axis.xaxis.set_major_locator(style.MaxNLocator(integer=True))
        axis.xaxis.set_major_formatter("{x:.0f}")
        axis.grid(axis="x", visible=False)
    style.legend(figure, panels[0][0], columns=5)
    return figure


def draw_weights(experiment: Experiment) -> "Figure":
    """Figures 9 and 10: the optimistic weights of the first third of training, of all of it, and the returns."""
    from matplotlib.figure import Figure

    from vecpsmbpo.look import posterior, style

    lane = experiment.runs[0].lanes[0]
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    first, whole, returns = figure.subplots(1, 3)
    end = lane.epochs["env_steps"][-1]
    for axis, until, part in ((first, INITIAL * end, "first third"), (whole, end, "whole")):
        posterior.draw_weights(axis, lane, "env_steps", until=until)
        axis.set_title(part, loc="right", fontsize=9)
        style.steps_axis(axis, logged.of("env_steps").label)
    look, sampled = style.looks(2)
    style.line(returns, look, lane.epochs["env_steps"], lane.epochs["eval_return"], label="evaluation")
    style.line(returns, sampled, lane.epochs["env_steps"], lane.epochs["train_return"], label="in training")
    style.steps_axis(returns, logged.of("env_steps").label)
    returns.set_ylabel("return")
    returns.legend()
    where = f"experiment={experiment.name} size={experiment.size}"
    title = f"{lane.run.settings.task}: {where}, {lane.name}, τ = {lane.setting('temperature'):g}"
    figure.suptitle(title, x=0.01, ha="left", fontsize=9)
    return figure


def draw_schedules(experiment: Experiment) -> "Figure":
    """Figure 13: λ constant, falling and chosen online; the last panel has λ itself, on the first task."""
    from vecpsmbpo.look import plot, style

    figure, panels, (ratios,) = _panels(experiment, ["real_ratio_schedule"], extra=1)
    looks = _looks(panels)
    for axis, _, here in panels:
        plot.draw_curves(axis, _curves(here), looks)
    _, task, first = panels[0]
    plot.draw_curves(ratios, _curves(first, "real_ratio"), looks)
    ratios.set_title(f"λ on {task}")
    ratios.set_ylabel("λ")
    ratios.set_ylim(-0.03, 1.03)
    style.steps_axis(ratios, logged.of("env_steps").label)
    style.legend(figure, ratios, columns=3)
    return figure


def draw_states(experiment: Experiment) -> "Figure":
    """Figures 8, 18 and 19: where each algorithm was in each third of its training, in one plane for each task."""
    from vecpsmbpo.look import style

    tasks = [(task, [one.lanes[0].run for one in here]) for task, here in experiment.tasks(["algo"])]
    columns = STAGES * max(len(found) for _, found in tasks)
    figure, axes = style.grid(columns * len(tasks), columns, (2.1, 2.2))
    progress = Console(stderr=True)
    rows = list(track(tasks, "UMAP", console=progress, transient=True, disable=not progress.is_terminal))
    for row, (task, found) in enumerate(rows):
        seen = [states.visited(one) for one in found]
        places = states.plane([one.obs for one in seen])
        everywhere = np.concatenate(places)
        for index, (one, place) in enumerate(zip(seen, places, strict=True)):
            last = one.steps.max() + 1
            look = style.looks(len(seen))[index]
            for stage in range(STAGES):
                axis = axes[row * columns + index * STAGES + stage]
                begin, end = last * stage // STAGES, last * (stage + 1) // STAGES
                here = place[(one.steps >= begin) & (one.steps < end)]
                axis.scatter(everywhere[:, 0], everywhere[:, 1], s=1, color=style.GRID, lw=0, rasterized=True)
                axis.scatter(here[:, 0], here[:, 1], s=2, color=look.colour, lw=0, rasterized=True)
                name = groups.display("algo", one.run.settings.algo)
                axis.set_title(f"{name}, steps {begin:,} to {end:,}", fontsize=8, fontweight="normal")
                axis.set_xticks([])
                axis.set_yticks([])
        axes[row * columns].set_ylabel(task)
    return figure


def table_1(experiment: Experiment) -> str:
    """Table 1 as Markdown: the hyperparameters that the runs had, and what both methods reached with them."""
    tasks = [(task, here[0].lanes[0].run.settings) for task, here in experiment.tasks()]
    optimistic = {
        run.settings.env: run.settings
        for run in experiment.runs
        if not math.isinf(getattr(run.settings, "temperature", math.inf))
    }
    lines = [["", *(task for task, _ in tasks)], ["---", *["---:"] * len(tasks)]]
    for name in TABLE_1:
        # τ is OPS-MBPO's; PS-MBPO's is infinite.
        cells = (groups.display(name, getattr(optimistic.get(task, settings), name)) for task, settings in tasks)
        lines.append([name, *cells])
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    options = {name: option.default for name, option in compare.OPTIONS.items()} | {"group": ("algo",)}
    return text + "\n\n" + compare.as_markdown(compare.table(experiment.runs, options), options)


DRAW: dict[str, Callable[[Experiment], Any]] = {
    "fig2": draw_regret,
    "fig4": functools.partial(draw_curves, reference="sac"),
    "fig5": draw_curves,
    "fig6": draw_averages,
    "fig7": draw_bars,
    "fig8": draw_states,
    "fig9": draw_weights,
    "fig10": draw_weights,
    "fig11": draw_curves,
    "fig12": draw_curves,
    "fig13": draw_schedules,
    "fig15": functools.partial(draw_curves, reference="mbpo"),
    "fig16": draw_curves,
    "fig17": draw_curves,
    "fig18": draw_states,
    "fig19": draw_states,
    "table1": table_1,
}
