"""What each task is, apart from its simulator: shared by its MJX port and its original."""

from vecpsmbpo.envs import termination
from vecpsmbpo.envs.registry import TASKS
from vecpsmbpo.types import EnvSpec

_TERMINATION = {
    "ant": termination.ant_leaves_its_height,
    "hopper": termination.hopper_falls,
    "walker2d": termination.walker_falls,
}


def get(name: str) -> EnvSpec:
    """The spec of one of the registry's own tasks."""
    sizes = TASKS[name].sizes
    assert sizes is not None, f"{name} is a suite, not a task"
    return EnvSpec(name, *sizes, _TERMINATION.get(name, termination.never))
