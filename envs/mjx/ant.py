"""Gymnasium Ant-v4 on MJX, observations without contact forces (27 numbers)."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.locomotion import Locomotion
from vecpsmbpo.envs.mjx.simulator import Physics

RESET_NOISE = 0.1
HEALTHY_REWARD, CONTROL_COST = 1.0, 0.5


class Ant(Locomotion):
    """Walk along x: reward 1 + velocity - 0.5 |a|²; ends when the torso leaves z in [0.2, 1] m."""

    spec = specs.get("ant")

    def __init__(self):
        super().__init__("ant.xml", substeps=5)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.around_start(key, RESET_NOISE, normal_velocity=True)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos[2:], physics.qvel])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        # The original takes the torso's body frame, which lags behind qpos, not qpos.
        velocity = (after.seen[0] - before.seen[0]) / self.dt
        return HEALTHY_REWARD + velocity - CONTROL_COST * jnp.sum(action**2)

    def terminated(self, physics: Physics) -> jax.Array:
        # The original also tests x and y, which it does not show, for being finite.
        return super().terminated(physics) | ~jnp.all(jnp.isfinite(physics.qpos))
