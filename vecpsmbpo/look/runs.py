"""Runs as they lie on disk, also damaged ones and ones that are being written.

Logs are read as columns, a batch of lines at a time: time and memory grow with the number of lines, and a million
episodes are some arrays and not a million dictionaries. Commands that somebody waits for show how far reading has come
(`load_all`, `load_each`).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo import config, jsonl
from vecpsmbpo.jsonl import EPISODES_FILE, METRICS_FILE
from vecpsmbpo.look import working
from vecpsmbpo.settings import SettingError, Settings

Array = np.ndarray
Columns = dict[str, Array]

LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class Log:
    """A JSONL file.

    Attributes:
        columns: by name, [L] floats each, NaN for null; `probs`, and other lists, [L, ...] float32.
        damaged: lines that could not be read and are left out; the last one does not count where it is merely
            unfinished, as in a run that is being written.
    """

    columns: Columns
    damaged: int

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))


@dataclass(frozen=True)
class Lane:
    """One seed of a run, with one of its swept values.

    Attributes:
        run: the run it belongs to.
        values: its seed and swept values, by name.
        epochs: columns of metrics.jsonl, [T] each, by rising steps.
        frozen: whether it stopped because something in it stopped being finite.
    """

    run: "Run"
    values: dict[str, float]
    epochs: Columns
    frozen: bool

    @property
    def name(self) -> str:
        """`seed 0`, or `seed 0, real_ratio 0.3`."""
        return ", ".join(f"{name} {value:g}" for name, value in self.values.items())

    @cached_property
    def episodes(self) -> Columns:
        """Columns of episodes.jsonl, [E] each; `probs` [E, N·M]."""
        return self.run.of_lane(self.values)

    def has_any(self, name: str) -> bool:
        """Whether averages of a column have it: not of a lane that was frozen before it had a value there."""
        return not self.frozen or bool(known(self.column(name)).any())

    def column(self, name: str) -> Array:
        """Of its epochs, [T], as `numbers` has it."""
        return numbers(self.epochs, name)

    def setting(self, name: str) -> Any:
        """The value that it has of a setting, swept or its run's; None where its algorithm has no such setting."""
        return self.values.get(name, getattr(self.run.settings, name, None))


@dataclass(frozen=True)
class Run:
    """A run directory.

    Attributes:
        path, settings: of the run.
        metrics: metrics.jsonl.
        watched: whether somebody waits for it: reading its episodes shows how far it has come.
    """

    path: Path
    settings: Settings
    metrics: Log
    watched: bool = False

    @cached_property
    def lanes(self) -> list[Lane]:
        """In the order of their first lines. A lane without a whole epoch is not there."""
        return list(self._lanes())

    def _lanes(self) -> Iterator[Lane]:
        names = ["seed", *(name for name, _ in self.settings.sweep)]
        table = np.stack([self.metrics.columns[name] for name in names], axis=1) if len(self.metrics) else np.empty(0)
        for row in dict.fromkeys(map(tuple, table.tolist())):
            values = dict(zip(names, row, strict=True))
            epochs = _where(self.metrics.columns, values)
            frozen = bool(np.nansum(epochs.get("frozen", np.zeros(1))))
            yield Lane(self, values, _rising(epochs), frozen)

    @cached_property
    def episodes(self) -> Columns:
        """Columns of episodes.jsonl of all lanes, [E] each; `probs` [E, N·M]."""
        path = self.path / EPISODES_FILE
        with working.reading([path] if self.watched else []) as advance:
            return read(path, needed=("env_steps", *self.settings.lanes[0]), advance=advance).columns

    def of_lane(self, values: Mapping[str, float]) -> Columns:
        """`episodes` of the lane with this seed and these swept values."""
        return _where(self.episodes, values)

    @property
    def env_steps(self) -> int:
        """How far it has come: the last whole epoch."""
        return int(self.metrics.columns["env_steps"].max()) if len(self.metrics) else 0

    @property
    def complete(self) -> bool:
        """Whether it has come to its end, or all of its lanes are frozen."""
        return self.env_steps >= self.settings.total_steps or (
            bool(self.lanes) and all(lane.frozen for lane in self.lanes)
        )

    @property
    def name(self) -> str:
        return self.path.resolve().name


def load(path: Path, advance: Callable[[int], object] | None = None) -> Run:
    """The run in a directory.

    Args:
        advance: as in `read`; with it, the run is one that somebody waits for.

    Raises:
        SettingError: there is none, or it cannot be read (`config.load`).
    """
    settings = config.load(path)
    try:
        metrics = read(path / METRICS_FILE, needed=("env_steps", *settings.lanes[0]), advance=advance)
    except OSError as error:
        raise SettingError(f"run_dir={path}: cannot be read ({error.strerror})") from None
    return Run(path, settings, metrics, watched=advance is not None)


def load_each(paths: Sequence[Path]) -> list[Run]:
    """The runs in directories, for a command: a terminal shows how far reading them has come.

    Raises:
        SettingError: as `load`.
    """
    with working.reading(path / METRICS_FILE for path in paths) as advance:
        return [load(path, advance) for path in paths]


def kept_steps(run: Run) -> list[int]:
    """Steps at which there is a checkpoint, oldest first."""
    return sorted(int(path.name) for path in (run.path / "checkpoints").glob("*") if path.name.isdecimal())


def check_lane(run: Run, lane: int) -> None:
    """Raises:
    SettingError: the run has no such lane.
    """
    if not 0 <= lane < len(run.settings.lanes):
        raise SettingError(f"lane={lane}: must be below {len(run.settings.lanes)}, the lanes of {run.path}")


def load_all(paths: Iterable[Path]) -> list[Run]:
    """As `load_each`, each with an epoch to show.

    Raises:
        SettingError: as `load`; or a run has not finished an epoch.
    """
    runs = load_each(list(paths))
    for run in runs:
        if not len(run.metrics):
            raise SettingError(f"run_dir={run.path}: has no whole epoch in {METRICS_FILE} yet")
    return runs


def warnings(runs: Iterable[Run]) -> Iterator[str]:
    """What a reader should know of the runs: a line each."""
    for run in runs:
        if run.metrics.damaged:
            yield f"{run.path / METRICS_FILE}: {run.metrics.damaged} damaged line(s) left out"
        if not run.complete:
            yield f"{run.path}: has come to step {run.env_steps:,} of {run.settings.total_steps:,}"
        for lane in run.lanes:
            if lane.frozen:
                before = "" if lane.has_any("eval_return") else "; no average has it, as it has no evaluation"
                yield f"{run.path}: {lane.name} was frozen at step {lane.epochs['env_steps'][-1]:.0f}{before}"


def numbers(columns: Columns, name: str) -> Array:
    """A column of metrics.jsonl, [L]; NaN where the log has none, or one of texts or lists."""
    column = columns.get(name)
    return np.full(len(columns["env_steps"]), np.nan) if column is None or column.ndim > 1 else column


def known(values: Array) -> Array:
    """Which values a run can have had, which computes in float32. Sums and squares of these are finite."""
    return np.abs(values) <= LARGEST  # False for NaN


def read(
    path: Path, needed: Iterable[str] = ("env_steps", "seed"), *, advance: Callable[[int], object] | None = None
) -> Log:
    """A JSONL file as columns; empty where there is no file.

    Args:
        needed: lines without these numbers count as damaged.
        advance: is told, again and again, how many more bytes have been read.
    """
    if not path.exists():
        return Log({}, 0)
    damaged = 0
    parts: list[Columns] = []
    with path.open("rb") as file:
        for batch in jsonl.batches(file, needed):
            if advance:
                advance(sum(len(text) for text, _ in batch))
            lines = [line for _, line in batch if line is not None]
            damaged += len(batch) - len(lines)
            if lines:
                parts.append(_columns(lines))
    return Log(_concatenate(parts), damaged)


def _columns(lines: list[dict[str, Any]]) -> Columns:
    names = dict.fromkeys(name for line in lines for name in line)
    found = {name: _column([line.get(name) for line in lines]) for name in names}
    return {name: column for name, column in found.items() if column is not None}


def _column(values: list[Any]) -> Array | None:
    """[L] floats, or [L, ...] where the values are lists, flattened. None where there is no number among them."""
    column: Array | None
    try:
        column = np.array(values, float)  # None becomes NaN, "inf" infinity
    except (TypeError, ValueError, OverflowError):
        column = _with_gaps(values)
    # Lists are probabilities of members, most of a log, and float32 themselves.
    return column if column is None or column.ndim < 2 else column.reshape(len(column), -1).astype(np.float32)


def _with_gaps(values: list[Any]) -> Array | None:
    """As `_column`, NaN where a value is null, a word, or a list where others are numbers."""
    found = [_numbers(value) for value in values]
    shapes = Counter(numbers.shape for numbers in found if numbers is not None)
    if not shapes:
        return None
    ((shape, _),) = shapes.most_common(1)
    gap = np.full(shape, np.nan)
    return np.stack([gap if numbers is None or numbers.shape != shape else numbers for numbers in found])


def _numbers(value: Any) -> Array | None:
    """A number or a list of them; None where it is neither."""
    try:
        return None if value is None else np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        return None


def _concatenate(parts: list[Columns]) -> Columns:
    """One column of each name, NaN where a part does not have it."""
    shapes = {name: column.shape[1:] for part in parts for name, column in part.items()}
    sizes = [len(next(iter(part.values()))) for part in parts]

    def whole(name: str, shape: tuple[int, ...]) -> Array:
        kind = np.float32 if shape else float
        there = (
            part[name] if name in part else np.full((size, *shape), np.nan, kind)
            for part, size in zip(parts, sizes, strict=True)
        )
        return np.concatenate(list(there))

    return {name: whole(name, shape) for name, shape in shapes.items()}


def _where(columns: Columns, values: Mapping[str, float]) -> Columns:
    """The rows in which columns have the given values."""
    if not columns:
        return {}
    chosen = np.logical_and.reduce([columns[name] == value for name, value in values.items()])
    return {name: column[chosen] for name, column in columns.items()}


def _rising(epochs: Columns) -> Columns:
    """By steps; of several lines of one step the last."""
    steps = epochs["env_steps"]
    _, last = np.unique(steps[::-1], return_index=True)
    order = len(steps) - 1 - last
    return {name: column[order] for name, column in epochs.items()}
