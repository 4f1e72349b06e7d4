"""Anybody's own Gymnasium environment."""

import gymnasium

from vecpsmbpo.envs import custom
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.envs.host.gymnasium import EPISODE_LENGTH, GymnasiumSimulator, batch, layers
from vecpsmbpo.settings import SettingError


def own_task(*, num_envs: int, seed: int, make: str) -> HostEnv:
    """`num_envs` of the environment that `make` (`package.module:attribute`) gives: a `gymnasium.Env`.

    A function `termination_rule` in its class is used as `EnvSpec.terminated`, where there is one; else termination is
    learned. Its time limit is the one that it is registered or wrapped with (`gymnasium.wrappers.TimeLimit`).

    Raises:
        SettingError: it is something else, or cannot be learned, or its rule gives something else.
    """
    label = f"env.make={make}"
    env = custom.load(make)
    if not isinstance(env, gymnasium.Env):
        raise SettingError(f"{label}: gives {type(env).__name__}, not a gymnasium.Env; or backend=mjx")
    rule = getattr(type(env.unwrapped), "termination_rule", None)  # of the class: on the object it would be a method
    every = [env, *(custom.load(make) for _ in range(num_envs - 1))]
    simulators = [GymnasiumSimulator(each, seed + index, label) for index, each in enumerate(every)]
    made = batch(simulators, make.rpartition(":")[2], _limit(env), rule)
    custom.check_rule(made.spec, label)
    return made


def _limit(env: gymnasium.Env) -> int:
    """Steps of an episode: of the outermost time limit, or as it is registered."""
    for layer in layers(env):
        if isinstance(layer, gymnasium.wrappers.TimeLimit):
            return layer._max_episode_steps
    return (env.unwrapped.spec and env.unwrapped.spec.max_episode_steps) or EPISODE_LENGTH
