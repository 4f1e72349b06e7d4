"""Anybody's own JAX environment."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

from vecpsmbpo.envs import custom
from vecpsmbpo.envs.mjx.adapter import Adapter
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec

EPISODE_LENGTH = 1000  # of a Brax environment without a spec


def own_task(*, make: str) -> Env:
    """The environment that `make` (`package.module:attribute`) gives: a `brax.envs.base.Env`.

    With an attribute `spec` (an `EnvSpec`, as every `MjxEnv` has) it is used as it is; without, termination is learned.

    Raises:
        SettingError: it is something else, or does not give what its spec says.
        Exception: whatever its `reset` and `step` raise.
    """
    env = custom.load(make)
    if not isinstance(env, Env):
        raise SettingError(f"env.make={make}: gives {type(env).__name__}, not a brax.envs.base.Env; or backend=host")
    if not hasattr(env, "spec"):
        env = Adapter(env, f"env.make={make}", make.rpartition(":")[2], EPISODE_LENGTH, None)
    if not isinstance(env.spec, EnvSpec):
        raise SettingError(f"env.make={make}: its spec is of {type(env.spec).__name__}, not an EnvSpec")
    _check_shapes(env, f"env.make={make}")
    custom.check_rule(env.spec, f"env.make={make}")
    return env


def _check_shapes(env: Env, label: str) -> None:
    """That `reset` and `step` give what the spec says, and the same: a mistake shows here, and not in the middle of a
    program that they are a small part of.

    Raises:
        SettingError: they do not.
        Exception: whatever they raise.
    """
    first = jax.eval_shape(env.reset, jax.random.key(0))
    _check_state(first, env.spec, f"{label}: its reset")
    action = jax.ShapeDtypeStruct((env.spec.action_size,), jnp.float32)
    after = jax.eval_shape(env.step, first, action)
    _check_state(after, env.spec, f"{label}: its step")
    structures: list[Any] = [jax.tree.structure(state) for state in (first, after)]
    if structures[0] != structures[1]:
        raise SettingError(f"{label}: its step gives a State of other parts than its reset")
    parts = zip(jax.tree_util.tree_leaves_with_path(first), jax.tree.leaves(after), strict=True)
    for (path, one), other in parts:
        if (one.shape, one.dtype) != (other.shape, other.dtype):
            name = jax.tree_util.keystr(path)
            raise SettingError(
                f"{label}: its step gives State{name} as {other.dtype}{list(other.shape)}, and its reset as "
                f"{one.dtype}{list(one.shape)}"
            )


def _check_state(state: Any, spec: EnvSpec, what: str) -> None:
    if not isinstance(state, State):
        given = "an array" if isinstance(state, jax.ShapeDtypeStruct) else type(state).__name__
        raise SettingError(f"{what} gives {given}, not a brax.envs.base.State")
    for name, shape in (("obs", (spec.obs_size,)), ("reward", ()), ("done", ())):
        found = getattr(getattr(state, name), "shape", None)  # obs may be a dictionary
        if found != shape:
            raise SettingError(f"{what} gives {name} of shape {found}, not {shape}")
