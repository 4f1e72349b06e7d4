"""Which tasks there are, on which backends. Imports no simulator until `make` needs one."""

import importlib
import importlib.util
from dataclasses import dataclass
from typing import Any

from vecpsmbpo.settings import SettingError


@dataclass(frozen=True)
class Task:
    """What `vecpsmbpo envs` lists of a task, and where its code is.

    Attributes:
        obs_size, action_size, episode_length: as in `EnvSpec`.
        suite: the importable package that holds the original.
        mjx: `module:class` of the MJX port below `vecpsmbpo.envs.mjx`, or None.
        host: `module:function` of the host environment below `vecpsmbpo.envs.host`, or None.
    """

    obs_size: int
    action_size: int
    episode_length: int
    suite: str
    mjx: str | None
    host: str | None

    @property
    def backends(self) -> tuple[str, ...]:
        return tuple(name for name in ("mjx", "host") if getattr(self, name))

    @property
    def installed(self) -> bool:
        return importlib.util.find_spec(self.suite) is not None


TASKS = {
    "ant": Task(27, 8, 1000, "gymnasium", "ant:Ant", "gymnasium:ant"),
    "ball_in_cup": Task(8, 2, 1000, "dm_control", "ball_in_cup:BallInCup", "dm_control:ball_in_cup"),
    "cartpole_swingup": Task(5, 1, 1000, "dm_control", "cartpole:CartpoleSwingup", "dm_control:cartpole_swingup"),
    "cartpole_swingup_sparse": Task(
        5, 1, 1000, "dm_control", "cartpole:CartpoleSwingupSparse", "dm_control:cartpole_swingup_sparse"
    ),
    "halfcheetah": Task(17, 6, 1000, "gymnasium", "halfcheetah:HalfCheetah", "gymnasium:halfcheetah"),
    "hopper": Task(11, 3, 1000, "gymnasium", "hopper:Hopper", "gymnasium:hopper"),
    "walker2d": Task(17, 6, 1000, "gymnasium", "walker2d:Walker2d", "gymnasium:walker2d"),
    "window_open": Task(39, 4, 250, "metaworld", None, "metaworld:window_open"),
}


def resolve_backend(name: str, backend: str = "auto") -> str:
    """`mjx` or `host`; `auto` takes MJX where the task has a port.

    Raises:
        SettingError: no such task, or it does not run on `backend`.
    """
    if name not in TASKS:
        raise SettingError(f"env={name}: must be one of {', '.join(TASKS)}")
    backends = TASKS[name].backends
    if backend == "auto":
        return backends[0]
    if backend not in backends:
        raise SettingError(f"backend={backend}: must be auto or {' or '.join(backends)} for env={name}")
    return backend


def make(name: str, backend: str = "auto", *, num_envs: int = 1, seed: int = 0) -> Any:
    """The task `name`.

    On `mjx`, one `brax.envs.base.Env` (batch it with `jax.vmap`; `num_envs` and `seed` are not used). On `host`, a
    `host.batched.HostEnv` of `num_envs` simulators, seeded seed, seed + 1, ….

    Raises:
        SettingError: no such task or backend, or its suite is not installed.
    """
    backend = resolve_backend(name, backend)
    task = TASKS[name]
    if not task.installed:
        raise SettingError(f"env={name}: needs the package {task.suite}; pip install {task.suite}")
    module, attribute = (task.mjx if backend == "mjx" else task.host).split(":")  # type: ignore[union-attr]
    found = getattr(importlib.import_module(f"vecpsmbpo.envs.{backend}.{module}"), attribute)
    return found() if backend == "mjx" else found(num_envs=num_envs, seed=seed)
