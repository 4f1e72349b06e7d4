"""Learning curves of groups of lanes: one line and its band from several seeds."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vecpsmbpo import logged
from vecpsmbpo.config import closest
from vecpsmbpo.look import statistics
from vecpsmbpo.look.groups import Group
from vecpsmbpo.look.runs import Lane, Run, known
from vecpsmbpo.settings import SettingError

Array = np.ndarray

POINTS = 200  # of a curve over seconds, where no two seeds share any
AVERAGES: dict[str, Callable[..., Array]] = {"mean": np.mean, "iqm": statistics.trimmed_mean}


@dataclass(frozen=True)
class Curve:
    """A line to draw.

    Attributes:
        name: of the group.
        x, y: [T] each.
        low, high: ends of the band around y, [T]; NaN where there is none.
        seeds: curves of the seeds, [S, T].
    """

    name: str
    x: Array
    y: Array
    low: Array
    high: Array
    seeds: Array

    @property
    def banded(self) -> bool:
        return bool(np.isfinite(self.low).any())


def columns(runs: Iterable[Run]) -> list[str]:
    """What can be drawn: every number in the runs' logs, but not what tells lines apart."""
    names = dict.fromkeys(name for run in runs for name, column in run.metrics.columns.items() if column.ndim == 1)
    return [name for name in names if name not in ("seed", "frozen")]


def check_columns(runs: Sequence[Run], option: str, names: Iterable[str]) -> None:
    """Says which name of an option is no column of the runs.

    Raises:
        SettingError: the first such.
    """
    known = columns(runs)
    for name in names:
        if name not in known:
            raise SettingError(f"{option}={name}: the runs have no such column; {closest(name, known)}")


def axis_label(name: str, runs: Iterable[Run]) -> str:
    """What an axis calls a column of the runs.

    Returns in training are of the episodes that are learned from: where these are shorter than evaluations (the setting
    `train_episode_length`), it says how long.
    """
    label, every = logged.of(name).label, [run.settings for run in runs]
    shorter = any(settings.train_episode_length not in (0, settings.episode_length) for settings in every)
    if name != "train_return" or not shorter:
        return label
    lengths = sorted({settings.training_limit for settings in every} - {0})
    return f"{label} (episodes of {' or '.join(f'{steps:,}' for steps in lengths)} steps)"


def bootstrap_band(seeds: Array, average: str = "mean") -> tuple[Array, Array]:
    """95% bootstrap interval of the average at every point: lower and upper end, [T] each, of curves [S, T]."""
    return statistics.band(seeds, AVERAGES[average])


def error_band(seeds: Array, average: str = "mean") -> tuple[Array, Array]:
    """One standard error of the mean to either side, as the paper's figures have it; NaN where there is one seed."""
    mean = seeds.mean(axis=0)
    with np.errstate(invalid="ignore"):
        error = seeds.std(axis=0) / np.sqrt(len(seeds) - 1)  # the same as with ddof=1 over sqrt(S); 0 / 0 for S = 1
    return mean - error, mean + error


def curve(
    group: Group,
    x: str,
    y: str,
    *,
    average: str = "mean",
    smooth: int = 1,
    band: Callable[[Array, str], tuple[Array, Array]] = bootstrap_band,
) -> Curve:
    """Average and band of a group, from the first point that all of its seeds have to the last.

    A frozen seed counts to the end with what it had reached, and not at all where it had no value yet. An epoch without
    a value (no episode ended in it) counts as the one before.

    Args:
        smooth: how many epochs each point is the mean of.
        band: of the seeds' curves [S, T] and the average's name.
    """
    return joined(group, [_line(lane, x, y, smooth) for lane in group.lanes], x, average=average, band=band)


def joined(
    group: Group,
    lines: list[tuple[Array, Array]],
    x: str,
    *,
    average: str = "mean",
    band: Callable[[Array, str], tuple[Array, Array]] = bootstrap_band,
) -> Curve:
    """As `curve`, of lines that somebody else has made: where each lane of the group has a value, and the value."""
    lines_with_frozen = [
        (line, lane.frozen) for line, lane in zip(lines, group.lanes, strict=True) if len(line[0]) or not lane.frozen
    ]
    lines = [line for line, _ in lines_with_frozen]
    if not lines or any(not len(at) for at, _ in lines):
        nothing = np.empty(0)
        return Curve(group.name, nothing, nothing, nothing, nothing, np.empty((len(lines), 0)))
    first = max(at[0] for at, _ in lines)
    going = [at[-1] for (at, _), frozen in lines_with_frozen if not frozen]
    last = min(going) if going else max(at[-1] for at, _ in lines)
    grid = np.unique(np.concatenate([at for at, _ in lines]))
    if x != "env_steps" and len(lines) > 1:
        grid = np.linspace(first, max(first, last), POINTS)
    grid = grid[(grid >= first) & (grid <= last)]
    seeds = np.stack([values[np.searchsorted(at, grid, side="right") - 1] for at, values in lines])
    low, high = band(seeds, average)
    return Curve(group.name, grid, AVERAGES[average](seeds, axis=0), low, high, seeds)


def _line(lane: Lane, x: str, y: str, smooth: int) -> tuple[Array, Array]:
    """Where a lane has a value, and the value."""
    at, values = lane.column(x), lane.column(y)
    there = known(at) & known(values)
    at, values = at[there], values[there]
    sums = np.cumsum(np.concatenate([[0.0], values]))
    ends = np.arange(1, len(values) + 1)
    begins = np.maximum(ends - smooth, 0)
    return at, (sums[ends] - sums[begins]) / (ends - begins) if smooth > 1 else values
