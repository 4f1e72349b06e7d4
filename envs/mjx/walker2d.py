"""Gymnasium Walker2d-v4 on MJX."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.locomotion import Locomotion
from vecpsmbpo.envs.mjx.simulator import Physics

RESET_NOISE = 5e-3
HEALTHY_REWARD, CONTROL_COST = 1.0, 1e-3


class Walker2d(Locomotion):
    """Walk forward without falling: reward 1 + velocity - 0.001 |a|²; ends when unhealthy."""

    spec = specs.get("walker2d")

    def __init__(self):
        super().__init__("walker2d.xml", substeps=4)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.around_start(key, RESET_NOISE, normal_velocity=False)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos[1:], jnp.clip(physics.qvel, -10.0, 10.0)])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        velocity = (after.qpos[0] - before.qpos[0]) / self.dt
        return HEALTHY_REWARD + velocity - CONTROL_COST * jnp.sum(action**2)

    def terminated(self, physics: Physics) -> jax.Array:
        obs = self.observe(physics)
        return self.spec.terminated(obs, obs, obs)
