"""Gymnasium HalfCheetah-v4 on MJX."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.locomotion import Locomotion
from vecpsmbpo.envs.mjx.simulator import Physics

RESET_NOISE = 0.1
CONTROL_COST = 0.1


class HalfCheetah(Locomotion):
    """Run forward: reward velocity - 0.1 |a|²; never ends."""

    spec = specs.get("halfcheetah")

    def __init__(self):
        super().__init__("half_cheetah.xml", substeps=5)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.around_start(key, RESET_NOISE, normal_velocity=True)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos[1:], physics.qvel])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        velocity = (after.qpos[0] - before.qpos[0]) / self.dt
        return velocity - CONTROL_COST * jnp.sum(action**2)
