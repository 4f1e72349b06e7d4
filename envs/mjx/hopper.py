"""Gymnasium Hopper-v4 on MJX."""

from pathlib import Path

import gymnasium.envs.mujoco as gymnasium_mujoco
import jax
import jax.numpy as jnp
import mujoco

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.base import MjxEnv, Physics

ASSETS = Path(gymnasium_mujoco.__file__).parent / "assets"
SUBSTEPS = 4
DT = 0.002 * SUBSTEPS
RESET_NOISE = 5e-3
HEALTHY_REWARD, CONTROL_COST = 1.0, 1e-3


class Hopper(MjxEnv):
    """Hop forward without falling: reward 1 + velocity - 0.001 |a|²; ends when unhealthy."""

    spec = specs.get("hopper")

    def __init__(self):
        super().__init__(mujoco.MjModel.from_xml_path(str(ASSETS / "hopper.xml")), substeps=SUBSTEPS)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def noise(key, size):
            return jax.random.uniform(key, (size,), minval=-RESET_NOISE, maxval=RESET_NOISE)

        position_key, velocity_key = jax.random.split(key)
        qpos0 = jnp.asarray(self.model.qpos0, jnp.float32)
        return qpos0 + noise(position_key, self.model.nq), noise(velocity_key, self.model.nv)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos[1:], jnp.clip(physics.qvel, -10.0, 10.0)])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        velocity = (after.qpos[0] - before.qpos[0]) / DT
        return HEALTHY_REWARD + velocity - CONTROL_COST * jnp.sum(action**2)

    def terminated(self, physics: Physics) -> jax.Array:
        # The original tests the velocities themselves, not the clipped ones that it shows.
        state = jnp.concatenate([physics.qpos[1:], physics.qvel])
        return self.spec.terminated(state, state, state)
