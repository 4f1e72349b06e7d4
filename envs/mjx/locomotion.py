"""What Gymnasium's four locomotion tasks share: their model files, and being paid for speed."""

from pathlib import Path

import gymnasium.envs.mujoco as gymnasium_mujoco
import jax
import jax.numpy as jnp
import mujoco

from vecpsmbpo.envs.mjx.base import MjxEnv
from vecpsmbpo.envs.mjx.simulator import LINE_SEARCH_ITERATIONS, Physics

ASSETS = Path(gymnasium_mujoco.__file__).parent / "assets"


class Locomotion(MjxEnv):
    """A Gymnasium MuJoCo task by its model file: reward `alive_reward` + velocity - `control_cost` |a|².

    Attributes:
        reset_noise: half width of the uniform noise on the initial qpos, and of that on qvel.
        normal_velocity: the noise on qvel is normal instead, with `reset_noise` as its standard deviation.
    """

    reset_noise: float
    normal_velocity: bool
    alive_reward: float
    control_cost: float

    def __init__(self, xml: str, substeps: int):
        model = mujoco.MjModel.from_xml_path(str(ASSETS / xml))
        super().__init__(model, substeps, line_search_iterations=LINE_SEARCH_ITERATIONS)
        self.dt = substeps * self.model.opt.timestep
        self._qpos0 = jnp.asarray(self.model.qpos0, jnp.float32)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Near the model's initial state: qpos [nq], qvel [nv]."""
        position_key, velocity_key = jax.random.split(key)
        draw = jax.random.normal if self.normal_velocity else _symmetric
        qpos = self._qpos0 + self.reset_noise * _symmetric(position_key, (self.model.nq,))
        return qpos, self.reset_noise * draw(velocity_key, (self.model.nv,))

    def forward_position(self, physics: Physics) -> jax.Array:
        """[] in m: what the velocity is the change of."""
        return physics.qpos[0]

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        velocity = (self.forward_position(after) - self.forward_position(before)) / self.dt
        return self.alive_reward + velocity - self.control_cost * jnp.sum(action**2)


class UprightLocomotion(Locomotion):
    """Hopper and Walker2d: velocities clipped to 10 in observations; they end when they fall."""

    reset_noise, normal_velocity, alive_reward, control_cost = 5e-3, False, 1.0, 1e-3
    largest_velocity = 10.0

    def observe(self, physics: Physics) -> jax.Array:
        velocity = jnp.clip(physics.qvel, -self.largest_velocity, self.largest_velocity)
        return jnp.concatenate([physics.qpos[1:], velocity])


def _symmetric(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)
