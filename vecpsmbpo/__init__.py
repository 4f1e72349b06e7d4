"""Posterior-sampling model-based policy optimization, vectorized end to end in JAX and MJX.

run = vecpsmbpo.train(env="cartpole_swingup", size="cpu", run_dir="runs/x")
run = vecpsmbpo.load("runs/x")
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from vecpsmbpo.api import Policy, Run
    from vecpsmbpo.settings import SettingError

__version__ = "0.1.0"
__all__ = ["SettingError", "load", "train"]


# Importing the package imports neither JAX nor MJX, which takes seconds: the command line answers at once. Nor anything
# else of its own: Ctrl-C is a traceback until `__main__` has come so far as to take care of it.


def __getattr__(name: str) -> Any:
    if name == "SettingError":
        from vecpsmbpo.settings import SettingError

        return SettingError
    if name == "envs":
        return importlib.import_module("vecpsmbpo.envs")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def train(**settings: Any) -> "Run":
    """Trains, as `vecpsmbpo train` does: see `api.train`."""
    return _api().train(**settings)


def load(path: "str | Path", lane: int = 0) -> "Run | Policy":
    """The run, or the exported policy, in a directory: see `api.Run` and `api.Policy`."""
    return _api().load(path, lane)


def _api() -> Any:
    from vecpsmbpo import limits

    if "jax" not in sys.modules:
        limits.check_start()
    return importlib.import_module("vecpsmbpo.api")
