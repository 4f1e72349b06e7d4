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
__all__ = ["SettingError", "envs", "load", "train"]


# Importing the package imports neither JAX nor MJX, which takes seconds: the command line answers at once. Nor anything
# else of its own: Ctrl-C is a traceback until `__main__` has come so far as to take care of it.


def __getattr__(name: str) -> Any:
    if name == "SettingError":
        from vecpsmbpo.settings import SettingError

        return SettingError
    if name == "envs":
        return importlib.import_module("vecpsmbpo.envs")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__} - {"Any", "TYPE_CHECKING", "importlib", "sys"})


def train(**settings: Any) -> "Run":
    """Trains, as `vecpsmbpo train` does: the same names, checks and files.

    `env.*` and `sweep.*` are `env_options={...}` and `sweep={...}`. A `run_dir` that holds a run goes on with it.
    Ctrl-C finishes the running chunk, saves, and returns; the run is then not `complete`. A lane in which something
    stopped being finite is held there (`health`): `frozen` says so in its last row of `metrics`.

    Raises:
        SettingError: a mistake in the settings, in one line.
        training.TaskFailed: the task's own code did, and how to go on.
        training.DiskError: the run directory cannot be written.
        training.OutOfMemory: the system gives no more.
    """
    return _api().train(**settings)


def load(path: "str | Path", lane: int = 0) -> "Run | Policy":
    """The run (`api.Run`), or the exported policy (`api.Policy`), in a directory.

    Args:
        lane: of a run: which seed, or seed with a swept value.

    Raises:
        SettingError: there is neither, or no such lane.
    """
    return _api().load(path, lane)


def _api() -> Any:
    from vecpsmbpo import limits

    if "jax" not in sys.modules:
        limits.check_start()
    return importlib.import_module("vecpsmbpo.api")
