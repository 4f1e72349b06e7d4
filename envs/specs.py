"""What each task is, apart from its simulator: shared by its MJX port and its original."""

from vecpsmbpo.envs import termination
from vecpsmbpo.envs.registry import TASKS
from vecpsmbpo.types import EnvSpec


def get(name: str) -> EnvSpec:
    """The spec of one of the registry's own tasks."""
    task = TASKS[name]
    assert task.sizes is not None, f"{name} is a suite, not a task"
    env_id = task.original.get("id")
    rule = termination.of_gymnasium(env_id) if env_id else termination.never
    assert rule is not None, f"{env_id}: has no rule in `termination.OF_GYMNASIUM`"
    return EnvSpec(name, *task.sizes, rule)
