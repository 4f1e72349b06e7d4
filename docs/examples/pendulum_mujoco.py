"""A robot of your own from its MJCF file, stepped by C MuJoCo: swing a pendulum up with a motor too weak to lift it.

    cd docs/examples
    vecpsmbpo train env=custom env.make=pendulum_mujoco:Pendulum backend=host episode_length=200 size=cpu

`pendulum_mjx.py` is the same task for MJX. On a CPU this one is stepped faster; on a GPU with many seeds, the other.
"""

from pathlib import Path

import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

from vecpsmbpo.envs import termination

SUBSTEPS = 5  # simulator steps per control step: 0.05 s


class Pendulum(MujocoEnv):
    """Reward (1 + cos θ) / 2, θ = 0 upright, less a little for effort; never ends."""

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 20}
    # Of (obs, action, next_obs), in jax.numpy: imagined rollouts end by it. Without one the models learn `terminated`.
    termination_rule = staticmethod(termination.never)

    def __init__(self):
        robot = str(Path(__file__).with_name("pendulum.xml"))
        super().__init__(robot, SUBSTEPS, observation_space=Box(-np.inf, np.inf, (3,)), render_mode="rgb_array")

    def reset_model(self):
        self.set_state(np.pi + self.np_random.uniform(-0.3, 0.3, 1), np.zeros(1))
        return self._observation()

    def step(self, action):
        self.do_simulation(action, self.frame_skip)
        reward = (1 + np.cos(self.data.qpos[0])) / 2 - 0.01 * float(action[0]) ** 2
        return self._observation(), reward, False, False, {}

    def _observation(self):
        angle = self.data.qpos[0]
        return np.array([np.cos(angle), np.sin(angle), self.data.qvel[0]])
