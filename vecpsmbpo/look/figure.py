"""`vecpsmbpo figure`: a figure of the paper, or its table, from the runs of its experiment.

`vecpsmbpo figure fig9 RUN` draws the picture of figures 9 and 10, how likely each member was to act, of any run.
"""

import functools
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecpsmbpo import arguments, config, logged
from vecpsmbpo.jsonl import EPISODES_FILE
from vecpsmbpo.look import compare, experiments, files, groups, published, runs, states, working
from vecpsmbpo.look.curves import Curve, axis_label, curve, error_band, joined
from vecpsmbpo.look.experiments import Experiment
from vecpsmbpo.look.groups import Group
from vecpsmbpo.look.runs import Lane, Run
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
    if not named or named[0] not in DRAW:
        what = "takes the name of one"
        if named:
            what = f"{named[0]} is {'a drawing and is left out' if named[0] in DRAWINGS else 'no figure of the paper'}"
        raise SettingError(f"figure: {what}; one of {', '.join(DRAW)}")
    name, *run_dirs = named
    out = values["out"] or (None if name == "table1" else Path(f"{name}.png"))
    if out is not None:
        files.check_writable(out)
    if DRAW[name] is draw_states:
        states.check_umap()
    if run_dirs:
        run = _given(name, run_dirs, values)
        _write(functools.partial(weights, run), out, runs.warnings([run]))
    else:
        experiment = experiments.load(name, values["runs"], values["size"])
        _write(functools.partial(DRAW[name], experiment), out, experiment.warnings())
    return 0


def _given(name: str, run_dirs: Sequence[str], values: dict[str, Any]) -> Run:
    """The run that is named beside the figure.

    Raises:
        SettingError: there is none, or the figure is of more than one run.
    """
    if DRAW[name] is not draw_weights:
        taking = " and ".join(figure for figure, draw in DRAW.items() if draw is draw_weights)
        raise SettingError(f"figure: {name} is of the runs of experiment={name}; {taking} take a run")
    for option in ("size", "runs"):
        if values[option] != OPTIONS[option].default:
            raise SettingError(f"{option}={values[option]}: is of the runs of experiment={name}, and a run is named")
    (run,) = runs.load_all(arguments.run_dirs("figure", run_dirs, most=1))
    return run


def _write(make: Callable[[], Any], out: Path | None, warnings: Iterable[str]) -> None:
    """Makes the picture or the table's text and writes it into `out`; None: the text is printed."""
    from vecpsmbpo.look import style  # here, not above: mistakes answer before matplotlib is imported

    with style.styled():
        made = make()
        for text in warnings:
            print(f"vecpsmbpo: warning: {text}", file=sys.stderr)
        if out is None:
            print(made, end="")
            return
        if isinstance(made, str):
            files.write_text(out, made)
        else:
            style.save(made, out)
    print(f"written: {out}")


Panel = tuple["Axes", str, list[Group]]  # with its task, and what is drawn of it


def _panels(
    experiment: Experiment, by: Sequence[str] = (), *, extra: int = 0, band: str = "band"
) -> tuple["Figure", list[Panel], list["Axes"]]:
    """A figure with a panel for every task, in groups `by` (`groups.group`), and `extra` ones after them.

    Args:
        band: what shows the standard error.
    """
    from vecpsmbpo.look import plot, style

    tasks = list(experiment.tasks(by))
    figure, axes = style.grid(len(tasks) + extra, plot.COLUMNS, (4.4, 3.0))
    drawn = groups.averaged((one for _, here in tasks for one in here), "mean of", f"{band}: standard error")
    style.title(figure, f"experiment={experiment.name} size={experiment.size}: {drawn}", size=9)
    for axis, (task, _) in zip(axes, tasks, strict=False):
        axis.set_title(style.literal(task))
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


def _check_evaluated(experiment: Experiment) -> None:
    """Raises:
    SettingError: no run has an evaluation to show.
    """
    nothing = np.empty(0)
    if not any(runs.known(run.metrics.columns.get("eval_return", nothing)).any() for run in experiment.runs):
        raise SettingError(f"{experiment.name}: eval_return is null in every line of its runs")


def draw_curves(experiment: Experiment, *, reference: str = "") -> "Figure":
    """Learning curves of every task: figures 4, 5, 11, 12, 15, 16 and 17.

    Args:
        reference: `sac` draws the asymptote of figures 4 and 5, `mbpo` the MBPO* of figure 15, where they are known.
    """
    from vecpsmbpo.look import plot, style

    _check_evaluated(experiment)
    figure, panels, _ = _panels(experiment)
    looks, references = _looks(panels), published.REFERENCES.get(reference, {})
    for axis, task, here in panels:
        plot.draw_curves(axis, _curves(here), looks)
        plot.draw_references(axis, [references[task]] if task in references else [])
    style.legend(figure, figure.axes, columns=6)
    return figure


def regret(lane: Lane, best: float) -> tuple[Array, Array]:
    """When the lane's episodes ended, and the regret accumulated until then: Σ (best - return), [E] each."""
    nothing = np.empty(0)
    at, earned = lane.episodes.get("env_steps", nothing), lane.episodes.get("return", nothing)
    there = runs.known(earned)
    return at[there], np.cumsum(best - earned[there])


def draw_regret(experiment: Experiment) -> "Figure":
    """Figure 2: cumulative regret for each λ."""
    from vecpsmbpo.look import plot, style

    figure, panels, _ = _panels(experiment)
    for axis, _, here in panels:
        scale = published.scale(here[0].lanes[0].run.settings)
        assert scale, "figure 2 is of a task whose rewards are bounded"
        lines = [[regret(lane, scale[1]) for lane in one.lanes] for one in here]
        if not any(len(at) for line in lines for at, _ in line):
            raise _no_episodes(here[0].lanes[0].run)
        curves = [joined(one, line, "env_steps", band=error_band) for one, line in zip(here, lines, strict=True)]
        plot.draw_curves(axis, curves, _looks(panels))
        axis.set_ylabel("cumulative regret")
    style.legend(figure, figure.axes, columns=3)
    return figure


def _no_episodes(run: Run) -> SettingError:
    return SettingError(f"run_dir={run.path}: has no whole episode in {EPISODES_FILE} yet")


def draw_averages(experiment: Experiment) -> "Figure":
    """Figure 6: a policy sampled for each episode (solid) against the average of all (dashed, hollow marks), by M."""
    from vecpsmbpo.look import style

    _check_evaluated(experiment)
    figure, panels, _ = _panels(experiment, ["n_policies", "posterior"])
    sizes = sorted({run.settings.policies_per_model for run in experiment.runs})
    looks = dict(zip(sizes, style.looks(len(sizes)), strict=True))
    for axis, _, here in panels:
        for one, line in zip(here, _curves(here), strict=True):
            m, average = one.values["n_policies"], one.values["posterior"] == "average"
            look = looks[m]._replace(dashes="--" if average else "-")
            name = f"M = {m}, {'average' if average else 'sampled'}"
            # A legend's piece of a line is too short to show dashes.
            hollow = {"mfc": style.PAPER} if average else {}
            style.line(axis, look, line.x, line.y, low=line.low, high=line.high, label=name, **hollow)
    style.legend(figure, figure.axes, columns=3)
    return figure


def last_evaluations(lane: Lane) -> float:
    """Mean of a lane's last ten evaluations; NaN where there is none."""
    evaluations = lane.epochs["eval_return"][-LAST:]
    there = evaluations[runs.known(evaluations)]
    return float(there.mean()) if len(there) else math.nan


def draw_bars(experiment: Experiment) -> "Figure":
    """Figure 7: the last ten evaluations for every N and M."""
    from vecpsmbpo.look import style

    _check_evaluated(experiment)
    figure, panels, _ = _panels(experiment, ["n_policies", "n_models"], band="whiskers")
    sizes = sorted({run.settings.policies_per_model for run in experiment.runs})
    width = 0.8 / len(sizes)
    for axis, task, here in panels:
        for index, (m, look) in enumerate(zip(sizes, style.looks(len(sizes), ordered=True), strict=True)):
            cells = [one for one in here if one.values["n_policies"] == m]
            lanes = ([lane for lane in one.lanes if lane.has_any("eval_return")] for one in cells)
            scores = [np.array([last_evaluations(lane) for lane in each]) for each in lanes]
            errors = [np.std(x, ddof=1) / np.sqrt(len(x)) if len(x) > 1 else 0.0 for x in scores]
            at = [one.values["n_models"] + (index - (len(sizes) - 1) / 2) * width for one in cells]
            means = [np.mean(x) if len(x) else math.nan for x in scores]
            axis.bar(at, means, 0.92 * width, color=look.colour, yerr=errors, label=f"M = {m}", error_kw={"lw": 0.9})
        axis.set_title(style.literal(f"{task}: last {LAST} evaluations"))
        axis.set_xlabel("number of models N")
        axis.xaxis.set_major_locator(style.MaxNLocator(integer=True))
        axis.xaxis.set_major_formatter("{x:.0f}")
        axis.grid(axis="x", visible=False)
    style.legend(figure, figure.axes, columns=5)
    return figure


def draw_weights(experiment: Experiment) -> "Figure":
    """Figures 9 and 10: the weights of the experiment's run."""
    return weights(experiment.runs[0], f"experiment={experiment.name} ")


def weights(run: Run, what: str = "") -> "Figure":
    """The optimistic weights of the first third of a run's training, of all of it, and the returns, of its first lane.

    Args:
        what: else the run is, for the title.

    Raises:
        SettingError: nobody is drawn in it, or no episode of it has ended.
    """
    from vecpsmbpo.look import posterior, style

    lane, settings = run.lanes[0], run.settings
    name = groups.display("algo", settings.algo)
    if settings.n_members < 2 or settings.averages_members:
        raise SettingError(f"run_dir={run.path}: {name} draws no member to act, so that there are no weights to show")
    if not len(lane.episodes.get("probs", ())):
        raise _no_episodes(run)
    figure, (first, whole, returns) = style.grid(3, 3, (4.3, 3.6))
    end = lane.epochs["env_steps"][-1]
    for axis, until, part in ((first, INITIAL * end, "first third"), (whole, end, "whole")):
        posterior.draw_weights(axis, lane, "env_steps", until=until)
        axis.set_title(part, loc="right", fontsize=9)
        style.steps_axis(axis, logged.of("env_steps").label)
    for look, y in zip(style.looks(2), ("eval_return", "train_return"), strict=True):
        style.line(returns, look, lane.epochs["env_steps"], lane.epochs[y], label=axis_label(y, [run]))
    style.steps_axis(returns, logged.of("env_steps").label)
    returns.set_ylabel("return")
    returns.legend()
    temperature = groups.label("temperature", lane.setting("temperature"))
    style.title(figure, f"{settings.task}, {name}: {what}size={settings.size}, {lane.name}, {temperature}", size=9)
    return figure


def draw_schedules(experiment: Experiment) -> "Figure":
    """Figure 13: λ constant, falling and chosen online; the last panel has λ itself, on the first task."""
    from vecpsmbpo.look import plot, style

    _check_evaluated(experiment)
    figure, panels, (ratios,) = _panels(experiment, ["real_ratio_schedule"], extra=1)
    looks = _looks(panels)
    for axis, _, here in panels:
        plot.draw_curves(axis, _curves(here), looks)
    _, task, first = panels[0]
    plot.draw_curves(ratios, _curves(first, "real_ratio"), looks)
    ratios.set_title(style.literal(f"λ on {task}"))
    ratios.set_ylabel("λ")
    ratios.set_ylim(-0.03, 1.03)
    style.steps_axis(ratios, logged.of("env_steps").label)
    style.legend(figure, figure.axes, columns=3)
    return figure


def draw_states(experiment: Experiment) -> "Figure":
    """Figures 8, 18 and 19: where each algorithm was in each third of its training, in one plane for each task."""
    from vecpsmbpo.look import style

    tasks = [(task, [one.lanes[0].run for one in here]) for task, here in experiment.tasks(["algo"])]
    columns = STAGES * max(len(found) for _, found in tasks)
    figure, axes = style.grid(columns * len(tasks), columns, (2.1, 2.2))
    for row, (task, found) in enumerate(working.steps(tasks, "UMAP")):
        names = [groups.display("algo", one.settings.algo) for one in found]
        looks = style.looks_of(names)
        seen = [states.visited(one) for one in found]
        places = states.plane([one.obs for one in seen])
        everywhere = np.concatenate(places)
        for index, (one, place) in enumerate(zip(seen, places, strict=True)):
            last, name = one.steps.max() + 1, names[index]
            for stage in range(STAGES):
                axis = axes[row * columns + index * STAGES + stage]
                begin, end = last * stage // STAGES, last * (stage + 1) // STAGES
                here = place[(one.steps >= begin) & (one.steps < end)]
                axis.scatter(everywhere[:, 0], everywhere[:, 1], s=1, color=style.GRID, lw=0, rasterized=True)
                axis.scatter(here[:, 0], here[:, 1], s=2, color=looks[name].colour, lw=0, rasterized=True)
                axis.set_title(f"{name}, steps {begin:,} to {end:,}", fontsize=8, fontweight="normal")
                axis.set_xticks([])
                axis.set_yticks([])
        axes[row * columns].set_ylabel(task)
    return figure


def table_1(experiment: Experiment) -> str:
    """Table 1 as Markdown: the hyperparameters that the runs had, and what both methods reached with them."""
    _check_evaluated(experiment)
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
    "fig5": functools.partial(draw_curves, reference="sac"),
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
