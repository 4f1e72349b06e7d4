"""Which tasks there are, on which backends. Imports no simulator until `make` needs one."""

import contextlib
import importlib
import importlib.util
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from vecpsmbpo import words
from vecpsmbpo.settings import SettingError


class Sizes(NamedTuple):
    """As in `EnvSpec`."""

    obs_size: int
    action_size: int
    episode_length: int


@dataclass(frozen=True)
class Task:
    """What a task is, apart from its simulators, and where its code is.

    Attributes:
        suite: the importable package that holds the original.
        code: by backend, `module:attribute` below `vecpsmbpo.envs.<backend>`: a class of MJX ports or a function that
            makes one, and a function that makes a `HostEnv`. The backend that `auto` takes comes first.
        original: what that function is told, to make this task's original.
        sizes: of this task; None for a whole suite, whose tasks are named by `env.*` options.
        rewards: the least and the most of a step, where they are bounded.
        needs: what to give to `pip install`, where installing this package may leave the suite out.
    """

    suite: str
    code: dict[str, str] = field(hash=False)
    original: dict[str, str] = field(default_factory=dict, hash=False)
    sizes: Sizes | None = None
    rewards: tuple[float, float] | None = None
    needs: str | None = None

    @property
    def backends(self) -> tuple[str, ...]:
        return tuple(self.code)

    @property
    def installed(self) -> bool:
        return importlib.util.find_spec(self.suite) is not None


# Without labmaze, which has no wheel for Python 3.13 (pyproject.toml).
DM_CONTROL = "--no-deps dm-control==1.0.49"


def _gymnasium(env_id: str, port: str, *sizes: int) -> Task:
    code = {"mjx": port, "host": "gymnasium:original"}
    return Task("gymnasium", code, {"id": env_id}, Sizes(*sizes))


def _dm_control(original: str, port: str, *sizes: int) -> Task:
    domain, task = original.split()
    code = {"mjx": port, "host": "dm_control:original"}
    return Task("dm_control", code, {"domain": domain, "task": task}, Sizes(*sizes), (0.0, 1.0), DM_CONTROL)


TASKS = {
    "ant": _gymnasium("Ant-v4", "ant:Ant", 27, 8, 1000),
    "ball_in_cup": _dm_control("ball_in_cup catch", "ball_in_cup:BallInCup", 8, 2, 1000),
    "cartpole_swingup": _dm_control("cartpole swingup", "cartpole:CartpoleSwingup", 5, 1, 1000),
    "cartpole_swingup_sparse": _dm_control("cartpole swingup_sparse", "cartpole:CartpoleSwingupSparse", 5, 1, 1000),
    "halfcheetah": _gymnasium("HalfCheetah-v4", "halfcheetah:HalfCheetah", 17, 6, 1000),
    "hopper": _gymnasium("Hopper-v4", "hopper:Hopper", 11, 3, 1000),
    "walker2d": _gymnasium("Walker2d-v4", "walker2d:Walker2d", 17, 6, 1000),
    "window_open": Task("metaworld", {"host": "metaworld:window_open"}, sizes=Sizes(39, 4, 250), rewards=(-10.0, 0.0)),
    # any task of a suite, and anybody's own
    "gymnasium": Task("gymnasium", {"host": "gymnasium:any_task"}),
    "dm_control": Task("dm_control", {"host": "dm_control:any_task"}, rewards=(0.0, 1.0), needs=DM_CONTROL),
    "metaworld": Task("metaworld", {"host": "metaworld:any_task"}),
    "playground": Task("mujoco_playground", {"mjx": "playground:any_task"}, needs="'vecpsmbpo[playground]'"),
    "brax": Task("brax", {"mjx": "brax:any_task"}),
    "custom": Task("vecpsmbpo", {"mjx": "custom:own_task", "host": "custom:own_task"}),
}


def names(backend: str) -> list[str]:
    """The tasks that need no options, on `backend`."""
    return [name for name, task in TASKS.items() if task.sizes and backend in task.code]


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


def check_installed(name: str) -> None:
    """Raises:
    SettingError: the suite of the task `name` is not installed.
    """
    task = TASKS[name]
    if not task.installed:
        raise SettingError(f"env={name}: needs the package {task.suite}; pip install {task.needs or task.suite}")


def make(name: str, backend: str = "auto", *, num_envs: int = 1, seed: int = 0, **options: Any) -> Any:
    """The task `name`.

    On `mjx`, one `brax.envs.base.Env` (batch it with `jax.vmap`; `num_envs` and `seed` are not used). On `host`, a
    `host.batched.HostEnv` of `num_envs` simulators, seeded seed, seed + 1, ….

    Args:
        options: which task of a suite, as `env.*` on the command line: `make("gymnasium", id="Swimmer-v5")`.

    Raises:
        SettingError: no such task or backend, its suite is not installed, it cannot be learned (images, discrete
            actions, none), or whatever its own code raises.
    """
    backend = resolve_backend(name, backend)
    check_installed(name)
    task = TASKS[name]
    module, attribute = task.code[backend].split(":")
    which = " ".join([f"env={name}", *(f"env.{option}={value}" for option, value in options.items())])
    try:
        found = getattr(importlib.import_module(f"vecpsmbpo.envs.{backend}.{module}"), attribute)
        with contextlib.chdir("."):  # to come back: a task that goes elsewhere must not take the run's files along
            own = {"name": name, **task.original} if task.original else {}
            made = found(**options) if backend == "mjx" else found(num_envs=num_envs, seed=seed, **own, **options)
        if min(made.spec.obs_size, made.spec.action_size) < 1:
            sizes = f"{made.spec.obs_size} observation(s) and {made.spec.action_size} action(s)"
            raise SettingError(f"{which}: has {sizes}; it must have at least one of each")
    except (SettingError, KeyboardInterrupt):
        raise
    except BaseException as error:  # SystemExit, too, and what a task has of its own
        raise SettingError(f"{which}: cannot be made ({words.of(error)})") from error
    return made
