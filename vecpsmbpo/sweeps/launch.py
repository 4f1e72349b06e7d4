"""From the grid that Hydra's sweeper made to jobs, and back to one exit status."""

import importlib
import importlib.util
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from vecpsmbpo import config, words
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.sweeps.job import Jobs, Outcome, Run

# By the launcher's name: the package that it needs, the extra that brings it, module and class of its jobs.
LAUNCHERS = {
    "submitit_local": ("submitit", "slurm", "vecpsmbpo.sweeps.on_submitit", "Local"),
    "submitit_slurm": ("submitit", "slurm", "vecpsmbpo.sweeps.on_submitit", "Slurm"),
    "ray": ("ray", "ray", "vecpsmbpo.sweeps.on_ray", "Tasks"),
}


def check(overrides: Sequence[str]) -> None:
    """Says which package the chosen launcher lacks.

    Raises:
        SettingError: it does.
    """
    for text in overrides:
        for name in config.chosen("hydra/launcher", text):
            if name not in LAUNCHERS:
                continue
            package, extra, _, _ = LAUNCHERS[name]
            if importlib.util.find_spec(package) is None:
                raise SettingError(f"{text}: needs the package {package}; pip install 'vecpsmbpo[{extra}]'")


def launch(name: str, options: Mapping[str, Any], grid: Sequence[Callable[[], Settings]]) -> int:
    """Runs a grid as jobs and shows them until all have ended. A run that cannot be made is one line, and takes no
    other with it.

    Args:
        name: of the launcher.
        options: what `hydra.launcher.*` says.
        grid: what makes the settings of each run.

    Returns:
        The worst exit status of all.

    Raises:
        SettingError: two runs would write into one directory, or the cluster takes none.
        Elsewhere: the jobs go on without this command.
    """
    from vecpsmbpo.sweeps import watch

    worst, runs = 0, []
    for make in grid:
        try:
            runs.append(Run(make(), Path.cwd()))
        except SettingError as error:
            words.complain(error)
            worst = 2
    for run_dir, count in Counter(run.settings.run_dir for run in runs).items():
        if count > 1:
            raise SettingError(f"run_dir={run_dir}: {count} runs of the grid would write into it at once")
    if not runs:
        return worst
    _, _, module, kind = LAUNCHERS[name]
    jobs: Jobs = getattr(importlib.import_module(module), kind)(runs, options)
    outcomes: list[Outcome] = watch.follow(jobs, runs)
    return max(worst, *(outcome.status for outcome in outcomes))
