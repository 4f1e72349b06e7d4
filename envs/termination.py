"""Termination rules as functions of observations: imagined rollouts end by them.

Each takes (obs [..., O], action [..., A], next_obs [..., O]) and gives bool [...]. They are written as "not healthy": a
comparison with NaN is false, so a state that is not finite terminates.
"""

import jax
import jax.numpy as jnp

from vecpsmbpo.types import TerminationRule

HOPPER_STATE_LIMIT, HOPPER_MIN_HEIGHT, HOPPER_MAX_ANGLE = 100.0, 0.7, 0.2
WALKER_MIN_HEIGHT, WALKER_MAX_HEIGHT, WALKER_MAX_ANGLE = 0.8, 2.0, 1.0
ANT_MIN_HEIGHT, ANT_MAX_HEIGHT = 0.2, 1.0
HUMANOID_MIN_HEIGHT, HUMANOID_MAX_HEIGHT = 1.0, 2.0
PENDULUM_MAX_ANGLE, PENDULUM_POLE, DOUBLE_PENDULUM_MIN_HEIGHT = 0.2, 0.6, 1.0


def never(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Tasks that only end by their time limit: obs [..., O] -> False [...]."""
    return jnp.zeros(jnp.shape(next_obs)[:-1], bool)


def hopper_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Hopper's rule on obs = (z, angle, three joints, six velocities)."""
    healthy = (
        jnp.isfinite(next_obs[..., 0])
        & jnp.all(jnp.abs(next_obs[..., 1:]) < HOPPER_STATE_LIMIT, axis=-1)
        & (next_obs[..., 0] > HOPPER_MIN_HEIGHT)
        & (jnp.abs(next_obs[..., 1]) < HOPPER_MAX_ANGLE)
    )
    return ~healthy


def walker_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Walker2d's rule on obs = (z, angle, ...)."""
    z, angle = next_obs[..., 0], next_obs[..., 1]
    return ~((z > WALKER_MIN_HEIGHT) & (z < WALKER_MAX_HEIGHT) & (jnp.abs(angle) < WALKER_MAX_ANGLE))


def ant_leaves_its_height(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Ant's rule on obs = (z, ...): not finite, or z outside [0.2, 1]."""
    z = next_obs[..., 0]
    return ~(jnp.all(jnp.isfinite(next_obs), axis=-1) & (z >= ANT_MIN_HEIGHT) & (z <= ANT_MAX_HEIGHT))


def humanoid_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """Humanoid's rule on obs = (z, ...)."""
    return ~((next_obs[..., 0] > HUMANOID_MIN_HEIGHT) & (next_obs[..., 0] < HUMANOID_MAX_HEIGHT))


def pendulum_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """InvertedPendulum's rule on obs = (x, angle, velocities): not finite, or |angle| > 0.2."""
    return ~(jnp.all(jnp.isfinite(next_obs), axis=-1) & (jnp.abs(next_obs[..., 1]) <= PENDULUM_MAX_ANGLE))


def double_pendulum_falls(obs: jax.Array, action: jax.Array, next_obs: jax.Array) -> jax.Array:
    """InvertedDoublePendulum's rule, tip not above 1 m, on obs = (x, sines and cosines of both angles, ...)."""
    sine, other_sine, cosine, other_cosine = (next_obs[..., index] for index in (1, 2, 3, 4))
    # cos(θ₁ + θ₂) from the sum's formula.
    height = PENDULUM_POLE * (cosine + cosine * other_cosine - sine * other_sine)
    return ~(height > DOUBLE_PENDULUM_MIN_HEIGHT)


# Gymnasium's MuJoCo tasks, whatever their version.
OF_GYMNASIUM: dict[str, TerminationRule] = {
    "Ant": ant_leaves_its_height,
    "HalfCheetah": never,
    "Hopper": hopper_falls,
    "Humanoid": humanoid_falls,
    "HumanoidStandup": never,
    "InvertedDoublePendulum": double_pendulum_falls,
    "InvertedPendulum": pendulum_falls,
    "Pusher": never,
    "Reacher": never,
    "Swimmer": never,
    "Walker2d": walker_falls,
}


def of_gymnasium(env_id: str) -> TerminationRule | None:
    """The rule of `env_id`, such as `Hopper-v5`; None where it is not known."""
    return OF_GYMNASIUM.get(env_id.rpartition("-v")[0])
