"""Gymnasium Hopper-v4 on MJX."""

import jax
import jax.numpy as jnp

from vecpsmbpo.envs import specs, termination
from vecpsmbpo.envs.mjx.locomotion import UprightLocomotion
from vecpsmbpo.envs.mjx.simulator import Physics


class Hopper(UprightLocomotion):
    """Hop forward without falling."""

    spec = specs.get("hopper")

    def __init__(self):
        super().__init__("hopper.xml", substeps=4)

    def terminated(self, obs: jax.Array, action: jax.Array, after: Physics) -> jax.Array:
        # The original tests the velocities themselves, not the clipped ones that it shows.
        state = jnp.concatenate([after.qpos[1:], after.qvel])
        return termination.hopper_falls(obs, action, state)
