"""Gymnasium's MuJoCo tasks on their own simulator."""

import warnings
from typing import Any

import gymnasium
import numpy as np

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.host.batched import HostEnv, Simulator
from vecpsmbpo.envs.host.mujoco_state import MujocoState


class GymnasiumSimulator(Simulator):
    """One Gymnasium MuJoCo environment without its wrappers."""

    def __init__(self, env_id: str, seed: int):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*out of date.*")  # the paper's tasks are the v4 ones
            self.env: Any = gymnasium.make(env_id).unwrapped
        self._low, self._high = self.env.action_space.low, self.env.action_space.high
        self._seed: int | None = seed
        self._state = MujocoState(self.env.model, self.env.data)

    def reset(self) -> np.ndarray:
        obs, _ = self.env.reset(seed=self._seed)
        self._seed = None  # the first reset seeds; later ones go on with the same generator
        self._state.begin_episode()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        self._state.begin_step(action)
        obs, reward, terminated, _, _ = self.env.step(self._low + (action + 1) * (self._high - self._low) / 2)
        return obs, float(reward), bool(terminated)

    def save(self) -> dict[str, Any]:
        generator = self.env.np_random.bit_generator.state
        return {"seed": self._seed, "physics": self._state.save(), "generator": generator}

    def load(self, saved: dict[str, Any]) -> None:
        self._seed = saved["seed"]
        action = self._state.load(saved["physics"])
        if action is not None:
            self.step(action)
        self.env.np_random.bit_generator.state = saved["generator"]


def _batched(name: str, env_id: str, num_envs: int, seed: int) -> HostEnv:
    return HostEnv(specs.get(name), [GymnasiumSimulator(env_id, seed + index) for index in range(num_envs)])


def ant(*, num_envs: int, seed: int) -> HostEnv:
    """Ant-v4."""
    return _batched("ant", "Ant-v4", num_envs, seed)


def halfcheetah(*, num_envs: int, seed: int) -> HostEnv:
    """HalfCheetah-v4."""
    return _batched("halfcheetah", "HalfCheetah-v4", num_envs, seed)


def hopper(*, num_envs: int, seed: int) -> HostEnv:
    """Hopper-v4."""
    return _batched("hopper", "Hopper-v4", num_envs, seed)


def walker2d(*, num_envs: int, seed: int) -> HostEnv:
    """Walker2d-v4."""
    return _batched("walker2d", "Walker2d-v4", num_envs, seed)
