"""Metaworld's tasks on their own simulator, and the paper's window_open.

One layout. A Metaworld task has a random vector, from which each reset places the objects and the goal. Here it is
drawn once per simulator and then kept, as in the suite's own `<task>-goal-observable` classes, for three reasons:

- What a learned model sees must determine what it predicts. Metaworld's dense rewards also use where the objects
  were at the reset, which is not in the observation; with one layout that is a constant.
- With a draw at each reset, the suite's first observation is wrong in seven tasks, window-open among them: `reset`
  draws twice and moves the object after the kinematics were computed, so it is shown where the first draw put it.
- The paper learns one task. Training and evaluation build their environments from different seeds, and must yet be
  on the same task; so all of `window_open` has the layout of one constant.

The goal is in the observation, where it is then a constant too. Nothing else in Metaworld is random.
"""

import sys
from typing import Any

import numpy as np
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

from vecpsmbpo.envs import specs, termination
from vecpsmbpo.envs.host import attributes
from vecpsmbpo.envs.host.batched import HostEnv, Simulator, diverged
from vecpsmbpo.envs.host.mujoco_state import MujocoState
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec

EPISODE_LENGTH = 500  # Metaworld's own limit
# Seed of the one layout, for training and evaluation alike. Chosen: window_open's window then stands 9 mm from the
# middle of the range that Metaworld draws x from.
LAYOUT = 0
WINDOW_THRESHOLD = 0.03  # m; chosen: the paper's "3 units" (C.3) are read as centimetres
WINDOW_OPEN_REWARD, WINDOW_NOT_OPEN_REWARD = 0.0, -10.0  # C.3


class MetaworldSimulator(Simulator):
    """One Metaworld task with its own dense reward: observation [39], action [4].

    The observation is (hand x y z in m, gripper opening 0 to 1, objects [14]), the same one step earlier, and the goal
    x y z in m.
    """

    def __init__(self, task: str, seed: int):
        """
        Args:
            task: a name such as `door-open-v3`.
            seed: draws the layout, and nothing else. Simulators with one seed are on the same task.

        Raises:
            SettingError: Metaworld has no such task.
        """
        if task not in ALL_V3_ENVIRONMENTS:
            raise SettingError(f"env.task={task}: must be one of {', '.join(ALL_V3_ENVIRONMENTS)}")
        self.env: Any = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-goal-observable"](seed=seed)
        self.env.max_path_length = sys.maxsize  # the suite raises an error beyond it; the time limit is HostEnv's
        self._state = MujocoState(self.env.model, self.env.data)

    def reset(self) -> np.ndarray:
        obs, _ = self.env.reset()
        self._state.begin_episode()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        self._state.begin_step(action)
        obs, reward, _, _, _ = self.env.step(action)  # Metaworld never terminates
        if self._state.diverged:
            return diverged(len(obs))
        return obs, float(reward), False, False

    def save(self) -> dict[str, Any]:
        return {
            "layout": self.env._last_rand_vec.tolist(),
            "physics": self._state.save(),
            "attributes": attributes.save(self.env),
        }

    def load(self, saved: dict[str, Any]) -> None:
        self.env._last_rand_vec = np.array(saved["layout"])
        self.env.reset()  # the layout moves bodies of the model, which are no part of MuJoCo's state
        action = self._state.load(saved["physics"])
        if action is not None:
            self.step(action)
        attributes.load(self.env, saved["attributes"])


class WindowOpenSimulator(MetaworldSimulator):
    """window-open-v3 with the sparse reward of C.3: 0 within `threshold` metres of open, else -10.

    The distance is that of the sliding window from the end of its rail. It is not Metaworld's distance of the handle
    from the goal: the goal lies 4 cm beyond where the handle can go, so 3 cm of it are never reached.
    """

    def __init__(self, seed: int, threshold: float):
        super().__init__("window-open-v3", seed)
        self._threshold = threshold
        self._slide = self.env.data.joint("window_slide")
        self._open = float(self.env.model.joint("window_slide").range[1])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        obs, _, terminated, truncated = super().step(action)
        is_open = abs(self._open - self._slide.qpos[0]) <= self._threshold
        return obs, WINDOW_OPEN_REWARD if is_open else WINDOW_NOT_OPEN_REWARD, terminated, truncated


def window_open(*, num_envs: int, seed: int, threshold: float = WINDOW_THRESHOLD) -> HostEnv:
    """window-open-v3 with the paper's sparse reward (C.3).

    Args:
        seed: not used, as nothing in the task is random: every episode starts from the same state.
        threshold: how far from fully open counts as open, in metres; the whole travel is 0.2 m.
    """
    return HostEnv(specs.get("window_open"), [WindowOpenSimulator(LAYOUT, threshold) for _ in range(num_envs)])


def any_task(*, num_envs: int, seed: int, task: str) -> HostEnv:
    """Any Metaworld v3 task with its own dense reward, such as `door-open-v3`.

    Args:
        seed: not used, as for `window_open`: one layout, so that training and evaluation are on the same task.

    Raises:
        SettingError: there is no such task.
    """
    simulators = [MetaworldSimulator(task, LAYOUT) for _ in range(num_envs)]
    return HostEnv(EnvSpec(task, 39, 4, EPISODE_LENGTH, termination.never), simulators)
