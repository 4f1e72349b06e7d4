"""`vecpsmbpo compare`: runs beside each other as a table, with the intervals that few seeds allow."""

import csv
import io
import itertools
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vecpsmbpo import arguments
from vecpsmbpo.look import files, groups, published, runs, statistics
from vecpsmbpo.look.curves import check_columns
from vecpsmbpo.look.groups import Group
from vecpsmbpo.look.runs import Lane, Run
from vecpsmbpo.look.statistics import Estimate
from vecpsmbpo.settings import SettingError

OPTIONS = {
    "y": arguments.text("the column of metrics.jsonl that is compared", "eval_return"),
    "group": arguments.names("settings whose values make a line each; without it, those that differ between the runs"),
    "steps": arguments.whole("up to which all are compared; 0: as far as all of a task have come", 0),
    "window": arguments.whole("epochs at the end that count as the final ones", 5, at_least=1),
    "threshold": arguments.number("a value; the table then says the first step with as much (`steps to`)"),
    "target": arguments.number("the value that counts as 1; without it, the task's own, if one is known"),
    "floor": arguments.number("the value that counts as 0; without it, the task's own, or 0"),
    "baseline": arguments.text("the line that the others are compared with; without it, the last"),
    "out": arguments.out("a file for the table; without it, the screen", "", ".csv", ".md", ".txt"),
}
NAN = float("nan")
UNKNOWN = Estimate(NAN, NAN, NAN)


@dataclass(frozen=True)
class Seed:
    """One lane's scores up to a step.

    Attributes:
        final: mean of the last `window` epochs.
        best: of all epochs.
        area: mean over steps: the area under the curve, in units of a return.
        reached: first step at which the threshold is met; infinite where it is not.
        seconds: wall time until then, of the whole run.
    """

    final: float
    best: float
    area: float
    reached: float
    seconds: float


@dataclass(frozen=True)
class Row:
    """A line of the table: a group on a task, or on all of them.

    Attributes:
        task, name: what it is of.
        env_steps: that were compared.
        scores: by task, the seeds' scores.
        cells: the numbers, by column.
        frozen: how many of the group's seeds are frozen, those included that have no score.
    """

    task: str
    name: str
    env_steps: int
    scores: dict[str, list[Seed]]
    cells: dict[str, Estimate]
    frozen: int


def run(words: Sequence[str]) -> int:
    """The command; its exit status.

    Raises:
        SettingError: a mistake in `words`, in the runs, or in where the table should go.
    """
    named, options = arguments.parse("compare", words, OPTIONS)
    paths = arguments.run_dirs("compare", named)
    if options["out"]:
        files.check_writable(options["out"])
    found = runs.load_all(paths)
    rows = table(found, options)
    if all(np.isnan(row.cells["final"].value) for row in rows):
        raise SettingError(f"y={options['y']}: is null in every line of the runs up to step {rows[0].env_steps:,}")
    if options["out"]:
        writers = {".csv": as_csv, ".md": as_markdown, ".txt": as_text}
        files.write_text(options["out"], writers[options["out"].suffix.lower()](rows, options))
        print(f"written: {options['out']}")
    else:
        print(as_text(rows, options), end="")
    for text in runs.warnings(found):
        print(f"vecpsmbpo: warning: {text}", file=sys.stderr)
    return 0


def table(found: Sequence[Run], options: dict[str, Any]) -> list[Row]:
    """A row for every group on every task, and, where there are several tasks, one for it on all of them together.

    Every group is taken to the same step of a task: the last that all its unfrozen lanes have reached.

    Raises:
        SettingError: as `groups.group`; a column is not there; `baseline` is no group; `steps` were not reached;
            `floor` is not below `target`.
    """
    check_columns(found, "y", [options["y"]])
    together = groups.group(found, options["group"])
    names = [one.name for one in together]
    if options["baseline"] and options["baseline"] not in names:
        raise SettingError(f"baseline={options['baseline']}: no such group; one of {'; '.join(names)}")
    base = options["baseline"] or names[-1]
    tasks = list(dict.fromkeys(lane.run.settings.task for one in together for lane in one.lanes))
    rows, scales = [], {}
    for task in tasks:
        here = [Group(one.values, [lane for lane in one.lanes if lane.run.settings.task == task]) for one in together]
        here = [one for one in here if one.lanes]
        scales[task] = _scale(here[0].lanes[0], options)
        steps = _common_steps(here, options["steps"])
        scored = {one.name: {task: _scores(one, steps, options)} for one in here}
        for one in here:
            frozen = sum(lane.frozen for lane in one.lanes)
            cells = _cells(scored[one.name], scored.get(base) if one.name != base else None, scales)
            rows.append(Row(task, one.name, steps, scored[one.name], cells, frozen))
    return rows + (_over_tasks(rows, tasks, base, scales) if len(tasks) > 1 else [])


def _common_steps(here: Sequence[Group], asked: int) -> int:
    """The step to compare at.

    Raises:
        SettingError: a lane has not come to the step asked for, and is not frozen.
    """
    lanes = [lane for one in here for lane in one.lanes]
    going = [lane for lane in lanes if not lane.frozen] or lanes
    for lane in going:
        if lane.epochs["env_steps"][-1] < asked:
            raise SettingError(f"steps={asked}: {lane.run.path} has not come to it ({lane.name})")
    return asked or int(min(lane.epochs["env_steps"][-1] for lane in going))


def _scores(group: Group, steps: int, options: dict[str, Any]) -> list[Seed]:
    lanes = [lane for lane in group.lanes if lane.has_any(options["y"])] or group.lanes
    return [score(lane, steps, options) for lane in lanes]


def score(lane: Lane, steps: int, options: dict[str, Any]) -> Seed:
    """A lane's scores up to `steps`. A frozen one keeps the value that it had reached."""
    at, values = lane.epochs["env_steps"], lane.column(options["y"])
    kept = (at <= steps) & runs.known(values)
    at, values = at[kept], values[kept]
    if not len(values):
        return Seed(NAN, NAN, NAN, NAN, NAN)
    if lane.frozen and at[-1] < steps:
        missing = np.arange(at[-1], steps, lane.run.settings.epoch_steps) + lane.run.settings.epoch_steps
        at, values = np.append(at, missing), np.append(values, np.full(len(missing), values[-1]))
    threshold = options["threshold"]
    reached = NAN if threshold is None else next((x for x, y in zip(at, values, strict=True) if y >= threshold), np.inf)
    seconds = lane.column("seconds")
    seconds = seconds[(lane.epochs["env_steps"] <= steps) & runs.known(seconds)]
    return Seed(
        final=float(values[-options["window"] :].mean()),
        best=float(values.max()),
        area=float(values.mean()),
        reached=float(reached),
        seconds=float(seconds.max()) if len(seconds) else NAN,
    )


def _scale(lane: Lane, options: dict[str, Any]) -> tuple[float, float] | None:
    """Returns that count as 0 and 1 (`published.scale`), unless the command line says otherwise.

    Raises:
        SettingError: what it says leaves no scale.
    """
    low, high = published.scale(lane.run.settings) or (0.0, NAN)
    given = {name: options[name] for name in ("floor", "target") if options[name] is not None}
    low, high = given.get("floor", low), given.get("target", high)
    if high > low:
        return low, high
    if given:
        said, task = " ".join(f"{name}={value:g}" for name, value in given.items()), lane.run.settings.task
        if np.isnan(high):
            raise SettingError(f"{said}: needs target=, too: what is to be reached on {task} is not known")
        raise SettingError(f"{said}: what counts as 0 on {task} ({low:g}) must be below what counts as 1 ({high:g})")
    return None


def _cells(scores: dict[str, list[Seed]], base: dict[str, list[Seed]] | None, scales: dict) -> dict[str, Estimate]:
    """The numbers of a group on one task."""
    (task, seeds) = next(iter(scores.items()))

    def of(take: Callable[[Seed], float]) -> list[np.ndarray]:
        return [np.array([take(seed) for seed in seeds])]

    reached = np.median(of(lambda seed: seed.reached)[0])
    cells = {
        "final": statistics.bootstrap(statistics.interquartile_mean, of(lambda seed: seed.final)),
        "best": statistics.bootstrap(statistics.interquartile_mean, of(lambda seed: seed.best)),
        "area": statistics.bootstrap(statistics.interquartile_mean, of(lambda seed: seed.area)),
        "steps to": Estimate(float(reached), NAN, NAN),
        "seconds": Estimate(float(np.median(of(lambda seed: seed.seconds)[0])), NAN, NAN),
    }
    if scales[task]:
        cells["optimality gap"] = statistics.bootstrap(statistics.optimality_gap, _normalised(scores, scales))
    if base:
        cells["P(better)"] = statistics.bootstrap(statistics.probability_of_improvement, _finals(scores), _finals(base))
    return cells


def _over_tasks(rows: Sequence[Row], tasks: Sequence[str], base: str, scales: dict) -> list[Row]:
    """Each group on all tasks, in units of their scales; groups and tasks that lack something are left out."""
    known = [task for task in tasks if scales[task]]
    scores: dict[str, dict[str, list[Seed]]] = {}
    for row in rows:
        scores.setdefault(row.name, {}).update(row.scores)
    whole = {name: found for name, found in scores.items() if set(known) <= set(found)}
    if len(known) < 2:
        return []
    found = []
    for name, mine in whole.items():
        mine = {task: mine[task] for task in known}
        final = _normalised(mine, scales)
        cells = {
            "final": statistics.bootstrap(statistics.interquartile_mean, final),
            "optimality gap": statistics.bootstrap(statistics.optimality_gap, final),
        }
        if name != base and base in whole:
            other = _normalised({task: whole[base][task] for task in known}, scales)
            cells["P(better)"] = statistics.bootstrap(statistics.probability_of_improvement, final, other)
        frozen = sum(row.frozen for row in rows if row.name == name and row.task in known)
        found.append(Row(f"all {len(known)} tasks, scaled", name, 0, mine, cells, frozen))
    return found


def _finals(scores: dict[str, list[Seed]]) -> list[np.ndarray]:
    return [np.array([seed.final for seed in seeds]) for seeds in scores.values()]


def _normalised(scores: dict[str, list[Seed]], scales: dict) -> list[np.ndarray]:
    return [
        (final - scales[task][0]) / (scales[task][1] - scales[task][0])
        for task, final in zip(scores, _finals(scores), strict=True)
    ]


# ── as text, Markdown and CSV ─────────────────────────────────────────────────────────────────────────────────────

FRACTIONS = ("optimality gap", "P(better)")
CELLS = ("final", "best", "area", "steps to", "optimality gap", "P(better)", "seconds")


def _columns(rows: Sequence[Row]) -> list[str]:
    """The columns in which any row has a number."""
    return [name for name in CELLS if any(not np.isnan(row.cells.get(name, UNKNOWN).value) for row in rows)]


def shown(cell: Estimate, *, fraction: bool = False) -> str:
    """`412 [380, 455]`; two digits after the point for fractions and below ten; a dash for what is not known."""
    if np.isnan(cell.value):
        return "–"
    if np.isinf(cell.value):
        return "not reached"
    digits = ",.2f" if fraction or abs(cell.value) < 10 else ",.0f"
    interval = "" if np.isnan(cell.low) else f" [{cell.low:{digits}}, {cell.high:{digits}}]"
    return f"{cell.value:{digits}}{interval}"


def _cell(row: Row, name: str) -> str:
    return shown(row.cells.get(name, UNKNOWN), fraction=name in FRACTIONS)


def _seeds(row: Row) -> str:
    count = sum(map(len, row.scores.values()))
    return f"{count} ({row.frozen} frozen)" if row.frozen else str(count)


def _title(row: Row) -> str:
    return f"{row.task}, to step {row.env_steps:,}" if row.env_steps else row.task


def caption(rows: Sequence[Row], options: dict[str, Any]) -> str:
    """What the columns are."""
    base = options["baseline"] or rows[-1].name
    parts = [
        f"Interquartile means over seeds of {options['y']}, with 95% stratified bootstrap intervals.",
        f"final: mean of the last {options['window']} epochs; best: of all; area: mean of all.",
    ]
    if any("optimality gap" in row.cells for row in rows):
        target = "the most possible, or where nobody knows that SAC's return after 3M steps"
        parts.append(f"Optimality gap: of the final score, 1 being {target} (target=).")
    if any("P(better)" in row.cells for row in rows):
        parts.append(f"P(better): that a run's final score is above one of {base} (baseline=).")
    if options["threshold"] is not None:
        parts.append(f"steps to: {options['threshold']:g} (threshold=), median over seeds.")
    if "seconds" in _columns(rows):
        parts.append("seconds: wall time of the program that a seed was in, with all other seeds in it; median.")
    if any(row.frozen for row in rows):
        parts.append("A frozen seed counts as what it had reached, and where it had reached nothing not at all.")
    return " ".join(parts)


def as_text(rows: Sequence[Row], options: dict[str, Any]) -> str:
    """Tables for a terminal of at least 120 characters, one below the other for each task."""
    console = Console(file=io.StringIO(), width=max(Console().width, 120), highlight=False)
    for (title, *names), body in cells(rows):
        table = Table(title=escape(title), title_justify="left", title_style="bold", header_style="", box=None)
        table.add_column("", no_wrap=True)
        for name in names:
            table.add_column(name, justify="right", no_wrap=True)
        for line in body:
            # Intervals stand below their numbers, to be no wider than a page.
            table.add_row(*(escape(cell.replace(" [", "\n[")) for cell in line))
        console.print(table)
    console.print(caption(rows, options), markup=False)
    return console.file.getvalue()  # type: ignore[attr-defined]


def cells(rows: Sequence[Row]) -> Iterator[tuple[list[str], list[list[str]]]]:
    """Head and lines of a table for each task, as text."""
    for title, part in itertools.groupby(rows, _title):
        lines = list(part)
        names = _columns(lines)
        body = [[row.name, _seeds(row), *(_cell(row, name) for name in names)] for row in lines]
        yield [title, "seeds", *names], body


def as_markdown(rows: Sequence[Row], options: dict[str, Any]) -> str:
    """As `as_text`, for a README."""
    parts = []
    for head, body in cells(rows):
        lines = [head, ["---", *["---:"] * (len(head) - 1)], *body]
        parts.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join([*parts, caption(rows, options)]) + "\n"


def as_csv(rows: Sequence[Row], options: dict[str, Any]) -> str:
    """Each number with the ends of its interval in columns of their own."""
    names, text = _columns(rows), io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    fields = [field for name in names for field in (name, f"{name} low", f"{name} high")]
    writer.writerow(["task", "group", "seeds", "frozen", "env_steps", *fields])
    for row in rows:
        numbers = [number for name in names for number in row.cells.get(name, UNKNOWN)]
        seeds = sum(map(len, row.scores.values()))
        cells = ["" if np.isnan(number) else f"{number:.5g}" for number in numbers]
        writer.writerow([row.task, row.name, seeds, row.frozen, row.env_steps, *cells])
    return text.getvalue()
