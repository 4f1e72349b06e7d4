"""Gymnasium HalfCheetah-v4 on MJX."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.locomotion import Locomotion
from vecpsmbpo.envs.mjx.simulator import Physics


class HalfCheetah(Locomotion):
    """Run forward; never ends."""

    spec = specs.get("halfcheetah")
    reset_noise, normal_velocity, alive_reward, control_cost = 0.1, True, 0.0, 0.1

    def __init__(self):
        super().__init__("half_cheetah.xml", substeps=5)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos[1:], physics.qvel])
