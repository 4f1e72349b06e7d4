"""What each task is, apart from its simulator: shared by its MJX port and its original."""

from vecpsmbpo.envs import termination
from vecpsmbpo.envs.registry import TASKS
from vecpsmbpo.types import EnvSpec, TerminationRule


def get(name: str) -> EnvSpec:
    """The spec of one of the registry's own tasks."""
    task = TASKS[name]
    assert task.sizes is not None, f"{name} is a suite, not a task"
    rule: TerminationRule = termination.never
    if env_id := task.original.get("id"):
        found = termination.of_gymnasium(env_id)
        assert found, f"{env_id}: has no rule in `termination.OF_GYMNASIUM`"
        rule = found
    return EnvSpec(name, *task.sizes, rule)
