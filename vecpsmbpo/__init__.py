"""Posterior-sampling model-based policy optimization, vectorized end to end in JAX and MJX.

run = vecpsmbpo.train(env="cartpole_swingup", size="cpu", run_dir="runs/x")
run = vecpsmbpo.load("runs/x")
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vecpsmbpo.settings import SettingError

if TYPE_CHECKING:
    from vecpsmbpo.api import Run

__version__ = "0.1.0"
__all__ = ["SettingError", "load", "train"]


# Importing the package imports neither JAX nor MJX, which takes seconds: the command line answers at once.


def train(**settings: Any) -> "Run":
    """Trains, as `vecpsmbpo train` does: see `api.train`."""
    from vecpsmbpo import api

    return api.train(**settings)


def load(run_dir: str | Path, lane: int = 0) -> "Run":
    """The run in a directory that training has written: see `api.Run`."""
    from vecpsmbpo import api

    return api.Run(run_dir, lane)
