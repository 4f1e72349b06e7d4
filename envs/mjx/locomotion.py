"""What Gymnasium's four locomotion tasks share: their model files, and being paid for speed."""

from pathlib import Path

import gymnasium.envs.mujoco as gymnasium_mujoco
import jax
import jax.numpy as jnp
import mujoco

from vecpsmbpo.envs.mjx.base import MjxEnv
from vecpsmbpo.envs.mjx.simulator import Physics

ASSETS = Path(gymnasium_mujoco.__file__).parent / "assets"


class Locomotion(MjxEnv):
    """A Gymnasium MuJoCo task by its model file."""

    def __init__(self, xml: str, substeps: int):
        super().__init__(mujoco.MjModel.from_xml_path(str(ASSETS / xml)), substeps)
        self.dt = substeps * self.model.opt.timestep
        self._qpos0 = jnp.asarray(self.model.qpos0, jnp.float32)

    def around_start(self, key: jax.Array, noise: float, *, normal_velocity: bool) -> tuple[jax.Array, jax.Array]:
        """qpos [nq] and qvel [nv] near the model's initial state.

        Args:
            noise: half width of the uniform noise on qpos, and on qvel unless that is normal with this s.d.
        """
        position_key, velocity_key = jax.random.split(key)
        draw = jax.random.normal if normal_velocity else _symmetric
        qpos = self._qpos0 + noise * _symmetric(position_key, (self.model.nq,))
        return qpos, noise * draw(velocity_key, (self.model.nv,))


class UprightLocomotion(Locomotion):
    """Hopper and Walker2d: reward 1 + velocity - 0.001 |a|², velocities clipped to 10 in observations."""

    reset_noise, alive_reward, control_cost, largest_velocity = 5e-3, 1.0, 1e-3, 10.0

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        return self.around_start(key, self.reset_noise, normal_velocity=False)

    def observe(self, physics: Physics) -> jax.Array:
        velocity = jnp.clip(physics.qvel, -self.largest_velocity, self.largest_velocity)
        return jnp.concatenate([physics.qpos[1:], velocity])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        velocity = (after.qpos[0] - before.qpos[0]) / self.dt
        return self.alive_reward + velocity - self.control_cost * jnp.sum(action**2)


def _symmetric(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
