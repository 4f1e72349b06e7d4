"""The runs behind a figure of the paper: which there should be, which there are, and the command that makes them."""

import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from vecpsmbpo import config
from vecpsmbpo.algorithms.catalogue import of_algorithm
from vecpsmbpo.look import groups, runs
from vecpsmbpo.look.groups import Group
from vecpsmbpo.look.runs import Run
from vecpsmbpo.settings import CHANGEABLE, SettingError, Settings

Point = Mapping[str, Any]  # of a grid: a value of each of its settings

# What runs of one point may differ in: seeds are counted, and the rest changes no curve.
_FREE = {"seed", "num_seeds", "run_dir", "backend"} | (
    CHANGEABLE - {"total_steps", "eval_episodes", "eval_policy", "eval_actions"}
)
SAID = 3  # things of a kind that a warning names


@dataclass(frozen=True)
class Experiment:
    """The runs of `experiment=<name>` of one size.

    Attributes:
        grid: the values of each setting that the experiment's runs differ in.
        runs: those that there are, with an epoch to show.
        others: runs that lie among them and are at no point of the grid.
    """

    name: str
    size: str
    grid: dict[str, list[Any]]
    runs: list[Run]
    others: list[Run]

    @property
    def command(self) -> str:
        """Makes the runs that are missing; those that are complete it leaves as they are."""
        return f"vecpsmbpo train -m experiment={self.name} size={self.size}"

    def tasks(self, by: Sequence[str] = ()) -> Iterator[tuple[str, list[Group]]]:
        """The groups (`groups.group`) of every task there are runs of, in the experiment's order."""
        for task in self.grid["env"]:
            if here := [run for run in self.runs if run.settings.env == task]:
                yield task, groups.group(here, by)

    def warnings(self) -> Iterator[str]:
        """What a reader of the figure should know: a line each."""
        points = _points(self.grid)
        at = [[run for run in self.runs if _is_at(run.settings, point)] for point in points]
        if missing := [_words(point) for point, found in zip(points, at, strict=True) if not found]:
            yield f"{self.name}: no run of {_some(missing)}; to make them: {self.command}"
        lacking = [
            text for point, found in zip(points, at, strict=True) if found for text in self._lacking(point, found)
        ]
        if lacking:
            yield f"{self.name}: {_some(lacking)}; to make them: {self.command}"
        for run in self.others:
            yield f"{run.path}: left out, {self.name} has no {_words({name: _of(run, name) for name in self.grid})}"
        for point, found in zip(points, at, strict=True):
            yield from (text for run in found for text in self._foreign(point, run))
        yield from runs.warnings(self.runs)

    def _wanted(self, point: Point) -> Settings:
        return _settings(self.name, self.size, tuple(point.items()))

    def _lacking(self, point: Point, found: Sequence[Run]) -> Iterator[str]:
        """The swept values of a point of which there are too few seeds; any seed is as good as another."""
        wanted = self._wanted(point)
        names = [name for name, _ in wanted.sweep]
        for values in itertools.product(*(values for _, values in wanted.sweep)):
            swept = dict(zip(names, values, strict=True))
            lanes = [lane for run in found for lane in run.lanes]
            seeds = {lane.values["seed"] for lane in lanes if all(lane.setting(name) == swept[name] for name in names)}
            if len(seeds) < wanted.num_seeds:
                yield f"{len(seeds)} of {wanted.num_seeds} seeds of {_words({**point, **swept})}"

    def _foreign(self, point: Point, run: Run) -> Iterator[str]:
        """What a run has that the experiment's would not have."""
        wanted = self._wanted(point)
        free = _FREE | {name for name, _ in (*wanted.sweep, *run.settings.sweep)}
        names = [name for name in of_algorithm(wanted.algo) if name not in free]
        different = [name for name in names if _of(run, name) != getattr(wanted, name)]
        if different:
            theirs = [f"{name}={_of(run, name)} (not {getattr(wanted, name)})" for name in different]
            yield f"{run.path}: is not as experiment={self.name} makes it: {_some(theirs)}"


def load(name: str, folder: Path, size: str = "") -> Experiment:
    """The experiment's runs below `folder`, of one size.

    Raises:
        SettingError: there are none (with the command that makes them), or they are of several sizes and none is asked
            for.
    """
    grid, there = _grid(name), folder / name
    paths = sorted(path.parent for path in there.glob(f"*/{config.CONFIG_FILE}"))
    every = [run for run in runs.load_each(paths) if len(run.metrics) and size in ("", run.settings.size)]
    found = [run for run in every if any(_is_at(run.settings, point) for point in _points(grid))]
    others = [run for run in every if run not in found]
    sizes = sorted({run.settings.size for run in found})
    if len(sizes) > 1:
        raise SettingError(f"size: the runs in {there} are of sizes {', '.join(sizes)}; say size=, one of them")
    if not found:
        what = f"none of the runs in {there} is one of its" if others else f"there are no runs in {there}"
        command = f"vecpsmbpo train -m experiment={name} size={size or 'cpu'}"
        raise SettingError(f"{name}: {what}; to make them: {command}")
    return Experiment(name, sizes[0], grid, found, others)


def _grid(name: str) -> dict[str, list[Any]]:
    """What the experiment's configuration has Hydra sweep."""
    text = (resources.files("vecpsmbpo.configs") / "experiment" / f"{name}.yaml").read_text()
    params = yaml.safe_load(text)["hydra"]["sweeper"]["params"]
    return {key: [yaml.safe_load(value) for value in str(values).split(",")] for key, values in params.items()}


def _points(grid: Mapping[str, list[Any]]) -> list[Point]:
    return [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]


def _is_at(settings: Settings, point: Point) -> bool:
    return all(getattr(settings, name, None) == value for name, value in point.items())


def _of(run: Run, name: str) -> Any:
    """The run's value of a setting; None where its algorithm has no such setting."""
    return getattr(run.settings, name, None)


@functools.cache
def _settings(name: str, size: str, point: tuple[tuple[str, Any], ...]) -> Settings:
    """What the experiment's run at a point has."""
    return config.compose_point(name, [f"size={size}", *(f"{key}={value}" for key, value in point)])


def _words(point: Point) -> str:
    return " ".join(f"{name}={value}" for name, value in point.items() if value is not None)


def _some(texts: Sequence[str]) -> str:
    """The first of them, and how many more there are."""
    more = f" and {len(texts) - SAID} more" if len(texts) > SAID else ""
    return ", ".join(texts[:SAID]) + more
