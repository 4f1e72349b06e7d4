"""The runs behind a figure of the paper: which there should be, which there are, and the command that makes them."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from vecpsmbpo import config
from vecpsmbpo.look import groups, runs
from vecpsmbpo.look.groups import Group
from vecpsmbpo.look.runs import Run
from vecpsmbpo.settings import SettingError, Settings


@dataclass(frozen=True)
class Experiment:
    """The runs of `experiment=<name>` of one size.

    Attributes:
        grid: the values of each setting that the experiment's runs differ in.
        runs: those that there are, with an epoch to show.
        missing: the points of the grid without one.
    """

    name: str
    size: str
    grid: dict[str, list[Any]]
    runs: list[Run]
    missing: list[dict[str, Any]]

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
        if self.missing:
            words = [" ".join(f"{name}={value}" for name, value in point.items()) for point in self.missing[:3]]
            more = f" and {len(self.missing) - 3} more" if len(self.missing) > 3 else ""
            yield f"{self.name}: no run of {', '.join(words)}{more}; to make them: {self.command}"
        yield from runs.warnings(self.runs)


def load(name: str, folder: Path, size: str = "") -> Experiment:
    """The experiment's runs below `folder`, of one size.

    Raises:
        SettingError: there are none (with the command that makes them), or they are of several sizes and none is asked
            for.
    """
    grid = _grid(name)
    wanted = [dict(zip(grid, point, strict=True)) for point in itertools.product(*grid.values())]
    paths = sorted(path.parent for path in (folder / name).glob(f"*/{config.CONFIG_FILE}"))
    found = [run for run in map(runs.load, paths) if len(run.metrics) and size in ("", run.settings.size)]
    sizes = sorted({run.settings.size for run in found})
    if len(sizes) > 1:
        raise SettingError(f"size: the runs in {folder / name} are of sizes {', '.join(sizes)}; say size=, one of them")
    if not found:
        command = f"vecpsmbpo train -m experiment={name} size={size or 'cpu'}"
        raise SettingError(f"{name}: there are no runs in {folder / name}; to make them: {command}")
    missing = [point for point in wanted if not any(_is_at(run.settings, point) for run in found)]
    return Experiment(name, sizes[0], grid, found, missing)


def _grid(name: str) -> dict[str, list[Any]]:
    """What the experiment's configuration has Hydra sweep."""
    text = (resources.files("vecpsmbpo.configs") / "experiment" / f"{name}.yaml").read_text()
    params = yaml.safe_load(text)["hydra"]["sweeper"]["params"]
    return {key: [yaml.safe_load(value) for value in str(values).split(",")] for key, values in params.items()}


def _is_at(settings: Settings, point: dict[str, Any]) -> bool:
    return all(getattr(settings, name) == value for name, value in point.items())
