"""Tasks of one's own that fail in the middle of a run, and are mended."""

import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tools.harm.runs import END, ONE_LINE, Trial, command, one_line, same_end

EXAMPLE = Path(__file__).parents[2] / "docs/examples/point_mass_gymnasium.py"
TASK = """
import sys
import numpy as np
from point_mass_gymnasium import PointMass

class Task(PointMass):
    steps = 0  # of all there are, those of evaluations included

    def step(self, action):
        Task.steps += 1
        obs, *more = super().step(action)
        return {gives} if Task.steps == {failing} else (obs, *more)
"""
FAULTS = {
    "raises": "[][0]",
    "leaves the program with status 0": "sys.exit(0)",
    "gives an observation of another shape": "(np.zeros(3), *more)",
    "gives no observation": "(None, *more)",
    "gives two rewards": "(obs, [1.0, 2.0], *more[1:])",
    "gives too few values": "(obs, *more[:2])",
}
# An evaluation, of an episode of 25 steps at most, comes after each 40 steps.
MOMENTS = {"training": (35, "failed at step"), "an evaluation": (41, "failed in the evaluation at step")}
RUN = ("env=custom", "env.make=task:Task", "backend=host", "size=tiny", "loggers=[]", f"total_steps={END}")


def simulators(folder: Path, options: dict) -> Iterator[Trial]:
    sound = folder / "sound"
    _write(sound, "obs", 0)
    assert command(*RUN, "run_dir=run", cwd=sound).returncode == 0
    for what, gives in FAULTS.items():
        for when, (failing, said) in MOMENTS.items():
            yield f"a task that {what} in {when}", partial(_mended, folder / "fails", gives, failing, said, sound)


def _mended(folder: Path, gives: str, failing: int, said: str, sound: Path) -> str:
    _write(folder, gives, failing)
    failed = command(*RUN, "run_dir=run", cwd=folder)
    ended = one_line(failed.returncode, failed.stderr, expected=1)
    if ended == ONE_LINE:
        assert said in failed.stderr, failed.stderr
        _write(folder, "obs", 0)
        command(*RUN, "run_dir=run", cwd=folder)
        ended = same_end(folder / "run", sound / "run")
    shutil.rmtree(folder)
    return ended


def _write(folder: Path, gives: str, failing: int) -> None:
    folder.mkdir(exist_ok=True)
    shutil.copy(EXAMPLE, folder)
    (folder / "task.py").write_text(TASK.format(gives=gives, failing=failing))
