"""The DeepMind control suite on its own simulator."""

from typing import Any

import numpy as np
from dm_control import suite

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.host.batched import HostEnv, Simulator
from vecpsmbpo.envs.host.mujoco_state import MujocoState


class DmControlSimulator(Simulator):
    """One task of the suite, observations flattened in the suite's order."""

    def __init__(self, domain: str, task: str, seed: int):
        self.env: Any = suite.load(domain, task, task_kwargs={"random": seed, "time_limit": float("inf")})
        action = self.env.action_spec()
        self._low, self._high = action.minimum, action.maximum
        physics = self.env.physics
        self._state = MujocoState(physics.model.ptr, physics.data.ptr)

    def reset(self) -> np.ndarray:
        obs = _flat(self.env.reset().observation)
        self._state.begin_episode()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        self._state.begin_step(action)
        timestep = self.env.step(self._low + (action + 1) * (self._high - self._low) / 2)
        terminated = bool(timestep.last() and timestep.discount == 0.0)
        return _flat(timestep.observation), float(timestep.reward), terminated

    def save(self) -> dict[str, Any]:
        generator = self.env.task.random.get_state(legacy=False)
        generator["state"]["key"] = generator["state"]["key"].tolist()
        return {"physics": self._state.save(), "generator": generator}

    def load(self, saved: dict[str, Any]) -> None:
        self.env.reset()  # a fresh environment answers its first step with a reset
        action = self._state.load(saved["physics"])
        if action is not None:
            self.step(action)
        generator = dict(saved["generator"], state=dict(saved["generator"]["state"]))
        generator["state"]["key"] = np.array(generator["state"]["key"], np.uint32)
        self.env.task.random.set_state(generator)


def _flat(observation: Any) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in observation.values()])


def _batched(name: str, domain: str, task: str, num_envs: int, seed: int) -> HostEnv:
    simulators = [DmControlSimulator(domain, task, seed + index) for index in range(num_envs)]
    return HostEnv(specs.get(name), simulators)


def ball_in_cup(*, num_envs: int, seed: int) -> HostEnv:
    """ball_in_cup catch."""
    return _batched("ball_in_cup", "ball_in_cup", "catch", num_envs, seed)


def cartpole_swingup(*, num_envs: int, seed: int) -> HostEnv:
    """cartpole swingup."""
    return _batched("cartpole_swingup", "cartpole", "swingup", num_envs, seed)


def cartpole_swingup_sparse(*, num_envs: int, seed: int) -> HostEnv:
    """cartpole swingup_sparse."""
    return _batched("cartpole_swingup_sparse", "cartpole", "swingup_sparse", num_envs, seed)
