"""A robot of your own from its MJCF file, on MJX: swing a pendulum up with a motor too weak to lift it.

    cd docs/examples
    vecpsmbpo train env=custom env.make=pendulum_mjx:Pendulum episode_length=200 size=cpu

Everything runs inside the one compiled program: the simulator, the models, the policies.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco

from vecpsmbpo.envs import termination
from vecpsmbpo.envs.mjx.base import MjxEnv
from vecpsmbpo.envs.mjx.simulator import Physics
from vecpsmbpo.types import EnvSpec

SUBSTEPS = 5  # simulator steps per control step: 0.05 s


class Pendulum(MjxEnv):
    """Reward (1 + cos θ) / 2, θ = 0 upright, less a little for effort; never ends."""

    # Imagined rollouts need the termination rule as a function of observations. `never`, one of your own,
    # or None: then the dynamics models learn what the method `terminated` says.
    spec = EnvSpec("pendulum", obs_size=3, action_size=1, episode_length=200, terminated=termination.never)

    def __init__(self):
        robot = Path(__file__).with_name("pendulum.xml")
        super().__init__(mujoco.MjModel.from_xml_path(str(robot)), SUBSTEPS)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """qpos [1] and qvel [1]: hanging, more or less."""
        angle = jnp.pi + jax.random.uniform(key, (1,), minval=-0.3, maxval=0.3)
        return angle, jnp.zeros(1)

    def observe(self, physics: Physics) -> jax.Array:
        """[3]: cos θ, sin θ, velocity in rad/s."""
        angle = physics.qpos[0]
        return jnp.stack([jnp.cos(angle), jnp.sin(angle), physics.qvel[0]])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        return (1 + jnp.cos(after.qpos[0])) / 2 - 0.01 * action[0] ** 2
