"""What each task is, apart from its simulator: shared by its MJX port and its original."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs.registry import TASKS
from vecpsmbpo.types import EnvSpec

HOPPER_STATE_LIMIT, HOPPER_MIN_HEIGHT, HOPPER_MAX_ANGLE = 100.0, 0.7, 0.2
WALKER_MIN_HEIGHT, WALKER_MAX_HEIGHT, WALKER_MAX_ANGLE = 0.8, 2.0, 1.0
ANT_MIN_HEIGHT, ANT_MAX_HEIGHT = 0.2, 1.0


def never(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Tasks that only end by their time limit: obs [..., O] -> False [...]."""
    return jnp.zeros(jnp.shape(next_obs)[:-1], bool)


def hopper_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Hopper-v4's rule on obs = (z, angle, three joints, six velocities).

    Written as "not healthy": a comparison with NaN is false, so a state that is not finite terminates.
    """
    healthy = (
        jnp.isfinite(next_obs[..., 0])
        & jnp.all(jnp.abs(next_obs[..., 1:]) < HOPPER_STATE_LIMIT, axis=-1)
        & (next_obs[..., 0] > HOPPER_MIN_HEIGHT)
        & (jnp.abs(next_obs[..., 1]) < HOPPER_MAX_ANGLE)
    )
    return ~healthy


def walker_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Walker2d-v4's rule on obs = (z, angle, ...)."""
    z, angle = next_obs[..., 0], next_obs[..., 1]
    return ~((z > WALKER_MIN_HEIGHT) & (z < WALKER_MAX_HEIGHT) & (jnp.abs(angle) < WALKER_MAX_ANGLE))


def ant_leaves_its_height(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Ant-v4's rule on obs = (z, ...): not finite, or z outside [0.2, 1]."""
    z = next_obs[..., 0]
    return ~(jnp.all(jnp.isfinite(next_obs), axis=-1) & (z >= ANT_MIN_HEIGHT) & (z <= ANT_MAX_HEIGHT))


_TERMINATION = {"ant": ant_leaves_its_height, "hopper": hopper_falls, "walker2d": walker_falls}


def get(name: str) -> EnvSpec:
    """The spec of a task in the registry."""
    task = TASKS[name]
    return EnvSpec(name, task.obs_size, task.action_size, task.episode_length, _TERMINATION.get(name, never))
