"""A task of your own with Gymnasium's interface: drive a point mass home before it leaves the field.

    cd docs/examples
    vecpsmbpo train env=custom env.make=point_mass_gymnasium:PointMass backend=host episode_length=100 size=cpu

Numbers, arrays, and lists and dictionaries of them that the environment keeps on itself are part of the checkpoint; so
is its `np_random`. What it keeps in objects of other kinds is not.
"""

import gymnasium
import numpy as np

STEP = 0.05  # s
FIELD = 2.0  # m, half width


class PointMass(gymnasium.Env):
    """Reward: minus the distance from the origin in m; ends at the field's edge with -10.

    There is no `termination_rule`, so the dynamics models learn where the edge is.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position = self.np_random.uniform(-1, 1, 2)
        self.velocity = np.zeros(2)
        return self._observation(), {}

    def step(self, action):
        self.velocity = self.velocity + STEP * 4 * np.asarray(action)
        self.position = self.position + STEP * self.velocity
        left = bool(np.abs(self.position).max() > FIELD)
        reward = -10.0 if left else -float(np.linalg.norm(self.position))
        return self._observation(), reward, left, False, {}

    def _observation(self):
        return np.concatenate([self.position, self.velocity]).astype(np.float32)
