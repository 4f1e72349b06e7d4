"""The DeepMind control suite on its own simulator."""

from typing import Any

import numpy as np
from dm_control import suite
from dm_control.rl.control import PhysicsError

from vecpsmbpo.envs import specs, termination
from vecpsmbpo.envs.host import attributes
from vecpsmbpo.envs.host.batched import HostEnv, Simulator, diverged
from vecpsmbpo.envs.host.mujoco_state import MujocoState
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec

LARGEST_ACTION = 1e6  # the suite gives actuators without a range one of 1e10
EPISODE_LENGTH = 1000  # of a task without a limit


class DmControlSimulator(Simulator):
    """One task of the suite, observations flattened in the suite's order."""

    def __init__(self, domain: str, task: str, seed: int):
        """
        Raises:
            SettingError: there is no such task, or its actions are not bounded.
        """
        if (domain, task) not in suite.ALL_TASKS:
            known = [name for found, name in suite.ALL_TASKS if found == domain]
            if not known:
                raise SettingError(f"env.domain={domain}: must be one of {', '.join(sorted(suite.TASKS_BY_DOMAIN))}")
            raise SettingError(f"env.task={task}: must be one of {', '.join(known)} for env.domain={domain}")
        self.env: Any = suite.load(domain, task, task_kwargs={"random": seed, "time_limit": float("inf")})
        action = self.env.action_spec()
        self._low, self._high = action.minimum, action.maximum
        if np.max(np.abs([self._low, self._high])) > LARGEST_ACTION:
            raise SettingError(f"env.domain={domain}: its actions are not bounded")
        physics = self.env.physics
        self._state = MujocoState(physics.model.ptr, physics.data.ptr)

    def reset(self) -> np.ndarray:
        obs = _flat(self.env.reset().observation)
        self._obs_size = obs.size
        self._state.begin_episode()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        self._state.begin_step(action)
        try:
            timestep = self.env.step(self._low + (action + 1) * (self._high - self._low) / 2)
        except PhysicsError:  # it has diverged
            return diverged(self._obs_size)
        terminated = bool(timestep.last() and timestep.discount == 0.0)
        return _flat(timestep.observation), float(timestep.reward), terminated, timestep.last() and not terminated

    def save(self) -> dict[str, Any]:
        generator = self.env.task.random.get_state(legacy=False)
        generator["state"]["key"] = generator["state"]["key"].tolist()
        return {"physics": self._state.save(), "attributes": attributes.save(self.env.task), "generator": generator}

    def load(self, saved: dict[str, Any]) -> None:
        self.env.reset()  # a fresh environment answers its first step with a reset
        action = self._state.load(saved["physics"])
        if action is not None:
            self.step(action)
        attributes.load(self.env.task, saved["attributes"])
        generator = dict(saved["generator"], state=dict(saved["generator"]["state"]))
        generator["state"]["key"] = np.array(generator["state"]["key"], np.uint32)
        self.env.task.random.set_state(generator)


def _flat(observation: Any) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in observation.values()])


def any_task(*, num_envs: int, seed: int, domain: str, task: str) -> HostEnv:
    """Any task of the suite, such as `finger`, `spin`. Its tasks do not terminate.

    Raises:
        SettingError: there is no such task, or its actions are not bounded.
    """
    simulators = _simulators(domain, task, num_envs, seed)
    env = simulators[0].env
    obs_size = sum(int(np.prod(part.shape)) for part in env.observation_spec().values())
    # The suite states its limit in seconds; it has been lifted here, so it is read off a second instance.
    limit = suite.load(domain, task)._step_limit
    limit = round(limit) if np.isfinite(limit) else EPISODE_LENGTH
    spec = EnvSpec(f"{domain}_{task}", obs_size, env.action_spec().shape[0], limit, termination.never)
    return HostEnv(spec, simulators)


def _simulators(domain: str, task: str, num_envs: int, seed: int) -> list[DmControlSimulator]:
    return [DmControlSimulator(domain, task, seed + index) for index in range(num_envs)]


def original(*, num_envs: int, seed: int, name: str, domain: str, task: str) -> HostEnv:
    """`task` of `domain` as the task `name`, which has a port."""
    return HostEnv(specs.get(name), _simulators(domain, task, num_envs, seed))
