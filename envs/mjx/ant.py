"""Gymnasium Ant-v4 on MJX, observations without contact forces (27 numbers)."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.locomotion import Locomotion
from vecpsmbpo.envs.mjx.simulator import Physics


class Ant(Locomotion):
    """Walk along x; ends when the torso leaves z in [0.2, 1] m."""

    spec = specs.get("ant")
    reset_noise, normal_velocity, alive_reward, control_cost = 0.1, True, 1.0, 0.5

    def __init__(self):
        super().__init__("ant.xml", substeps=5)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos[2:], physics.qvel])

    def forward_position(self, physics: Physics) -> jax.Array:
        # The original takes the torso's body frame, which lags behind qpos.
        return physics.seen[0]

    def terminated(self, obs: jax.Array, action: jax.Array, after: Physics) -> jax.Array:
        # The original also tests x and y, which it does not show, for being finite.
        return super().terminated(obs, action, after) | ~jnp.all(jnp.isfinite(after.qpos))
