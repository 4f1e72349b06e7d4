"""Anybody's own JAX environment."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env

from vecpsmbpo.envs import custom
from vecpsmbpo.envs.mjx.adapter import Adapter
from vecpsmbpo.settings import SettingError

EPISODE_LENGTH = 1000  # of a Brax environment without a spec


def own_task(*, make: str) -> Env:
    """The environment that `make` (`package.module:attribute`) gives: a `brax.envs.base.Env`.

    With an attribute `spec` (an `EnvSpec`, as every `MjxEnv` has) it is used as it is; without, termination is learned.

    Raises:
        SettingError: it is something else.
        Exception: whatever its `reset` and `step` raise.
    """
    env = custom.load(make)
    if not isinstance(env, Env):
        raise SettingError(f"env.make={make}: gives {type(env).__name__}, not a brax.envs.base.Env; or backend=host")
    if not hasattr(env, "spec"):
        env = Adapter(env, f"env.make={make}", make.rpartition(":")[2], EPISODE_LENGTH, None)
    # A mistake in it shows here, and not in the middle of a program that it is a small part of.
    state = jax.eval_shape(env.reset, jax.random.key(0))
    jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.spec.action_size,), jnp.float32))
    return env
