"""Anybody's own Gymnasium environment."""

import gymnasium

from vecpsmbpo.envs import custom
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.envs.host.gymnasium import batch
from vecpsmbpo.settings import SettingError


def own_task(*, num_envs: int, seed: int, make: str) -> HostEnv:
    """`num_envs` of the environment that `make` (`package.module:attribute`) gives: a `gymnasium.Env`.

    Its attribute `termination_rule` is used as `EnvSpec.terminated`, where it has one; else termination is learned.

    Raises:
        SettingError: it is something else, or cannot be learned.
    """
    label = f"env.make={make}"
    env = custom.load(make)
    if not isinstance(env, gymnasium.Env):
        raise SettingError(f"{label}: gives {type(env).__name__}, not a gymnasium.Env; or backend=mjx")
    rule = getattr(env.unwrapped, "termination_rule", None)
    return batch(lambda: custom.load(make), num_envs, seed, label, make.rpartition(":")[2], rule)
