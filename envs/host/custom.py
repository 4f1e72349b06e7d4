"""Anybody's own Gymnasium environment."""

import gymnasium

from vecpsmbpo.envs import custom
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.envs.host.gymnasium import EPISODE_LENGTH, GymnasiumSimulator, batch
from vecpsmbpo.settings import SettingError


def own_task(*, num_envs: int, seed: int, make: str) -> HostEnv:
    """`num_envs` of the environment that `make` (`package.module:attribute`) gives: a `gymnasium.Env`.

    A function `termination_rule` in its class is used as `EnvSpec.terminated`, where there is one; else termination is
    learned. Its time limit is the one that it is registered or wrapped with (`gymnasium.wrappers.TimeLimit`).

    Raises:
        SettingError: it is something else, or cannot be learned.
    """
    label = f"env.make={make}"
    env = custom.load(make)
    if not isinstance(env, gymnasium.Env):
        raise SettingError(f"{label}: gives {type(env).__name__}, not a gymnasium.Env; or backend=mjx")
    rule = getattr(type(env.unwrapped), "termination_rule", None)  # of the class: on the object it would be a method
    simulators = [GymnasiumSimulator(custom.load(make), seed + index, label) for index in range(num_envs)]
    return batch(simulators, make.rpartition(":")[2], _limit(env), rule)


def _limit(env: gymnasium.Env) -> int:
    """Steps of an episode: of the outermost time limit, or as it is registered."""
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.TimeLimit):
            return env._max_episode_steps
        env = env.env
    return (env.spec and env.spec.max_episode_steps) or EPISODE_LENGTH
