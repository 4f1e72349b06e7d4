"""A batch of host simulators: the interface that the host driver steps."""

import abc
import contextlib
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from vecpsmbpo import words
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec, possible


class SimulatorError(SettingError):
    """The code of a task failed, or gave what it cannot give: one line."""


class Simulator(abc.ABC):
    """One original simulator, with actions in [-1, 1]; its time limit, where that is known, is HostEnv's."""

    @abc.abstractmethod
    def reset(self) -> np.ndarray:
        """Begins an episode: obs [O]."""

    @abc.abstractmethod
    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """One control step: action [A] -> obs [O], reward, terminated, truncated.

        `truncated`: the episode ends here for a reason that is no part of the task, other than HostEnv's time limit.
        """

    @abc.abstractmethod
    def save(self) -> dict[str, Any]:
        """All that is needed to go on exactly as if nothing had happened, in JSON's types."""

    @abc.abstractmethod
    def load(self, saved: dict[str, Any]) -> None:
        """The inverse of `save`."""


def diverged(obs_size: int) -> tuple[np.ndarray, float, bool, bool]:
    """What a `Simulator` answers to a step in which it has: nothing that could be believed."""
    return np.full(obs_size, np.nan), np.nan, False, False


class HostStep(NamedTuple):
    """What a step of B environments gives.

    Attributes:
        obs: [B, O] the states that the next actions start from: after the automatic reset where an episode ended.
        reward: [B].
        terminated: [B] bool.
        truncated: [B] bool, the episode ended for another reason, as a rule its time limit.
        next_obs: [B, O] the true successors, also where an episode ended.
        sound: [B] bool, the step's numbers are possible; where they are not, the episode was truncated, unless it
            stands still.
    """

    obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    next_obs: np.ndarray
    sound: np.ndarray


class HostEnv:
    """B simulators of one task, stepped together, reset on their own.

    Attributes:
        spec: of the task.
        episode_length: the time limit, `spec.episode_length` unless set otherwise.
        simulators: one per environment.
    """

    def __init__(self, spec: EnvSpec, simulators: Sequence[Simulator]):
        self.spec = spec
        self.episode_length = spec.episode_length
        self.simulators = list(simulators)
        self._lengths = np.zeros(len(self.simulators), np.int64)
        self._obs = np.zeros((len(self.simulators), spec.obs_size), np.float32)

    @property
    def num_envs(self) -> int:
        return len(self.simulators)

    def reset(self) -> np.ndarray:
        """Begins an episode everywhere: obs [B, O].

        Raises:
            SimulatorError: one failed.
        """
        self._lengths[:] = 0
        with _others_code():
            self._obs = np.stack([self._shaped(simulator.reset()) for simulator in self.simulators])
        return self._obs

    def step(self, actions: np.ndarray, still: np.ndarray | None = None) -> HostStep:
        """actions [B, A] in [-1, 1]; values outside are clipped, and NaN is 0.

        A simulator that returns NaN, infinity or what is beyond 1e10 (`types.possible`) is reset.

        Args:
            still: [B] bool, simulators that are left as they are, since nothing is learned from what they say.

        Raises:
            ValueError: `actions` has another shape.
            SimulatorError: one failed. What it and the others did until then is not undone.
        """
        if np.shape(actions) != (self.num_envs, self.spec.action_size):
            expected = (self.num_envs, self.spec.action_size)
            raise ValueError(f"actions must have shape {expected}, not {np.shape(actions)}")
        # NaN: of a policy that has diverged, until its lane is frozen. Some simulators fail at it.
        actions = np.clip(np.nan_to_num(np.asarray(actions, np.float64)), -1.0, 1.0)
        still = np.zeros(self.num_envs, bool) if still is None else still
        with _others_code():
            results = [
                (before, 0.0, False, False) if is_still else simulator.step(action)
                for simulator, action, before, is_still in zip(self.simulators, actions, self._obs, still, strict=True)
            ]
            obs, rewards, terminated, cut = zip(*results, strict=True)
            next_obs = np.stack([self._shaped(one) for one in obs])
            with np.errstate(over="ignore"):  # to infinity, which is looked for
                reward = np.asarray(rewards, np.float64).astype(np.float32)
            terminated, cut = np.asarray(terminated, bool), np.asarray(cut, bool)
        sound = possible(np.column_stack([self._obs, next_obs, reward])).all(axis=1)
        terminated = terminated & sound
        self._lengths += ~still
        truncated = (cut | (self._lengths >= self.episode_length) | ~sound) & ~terminated & ~still
        self._obs = next_obs.copy()
        for index in np.flatnonzero(terminated | truncated):
            with _others_code():
                self._obs[index] = self._shaped(self.simulators[index].reset())
            self._lengths[index] = 0
        return HostStep(self._obs, reward, terminated, truncated, next_obs, sound)

    def _shaped(self, obs: Any) -> np.ndarray:
        """An observation as float32."""
        with np.errstate(over="ignore"):  # as in `step`
            found = np.asarray(obs).astype(np.float32)
        if found.shape != (self.spec.obs_size,):
            raise SimulatorError(f"an observation has shape {found.shape}, not ({self.spec.obs_size},)")
        return found

    def save(self) -> dict[str, Any]:
        """The state of every simulator, in JSON's types."""
        return {
            "lengths": self._lengths.tolist(),
            "obs": self._obs.tolist(),
            "simulators": [simulator.save() for simulator in self.simulators],
        }

    def load(self, saved: dict[str, Any]) -> np.ndarray:
        """The inverse of `save`: the observations [B, O] that the next actions start from.

        Raises:
            SimulatorError: one failed.
        """
        self._lengths = np.array(saved["lengths"], np.int64)
        self._obs = np.array(saved["obs"], np.float32)
        with _others_code():
            for simulator, state in zip(self.simulators, saved["simulators"], strict=True):
                simulator.load(state)
        return self._obs


@contextlib.contextmanager
def _others_code() -> Iterator[None]:
    """Turns whatever a simulator raises, leaving the program included, into one line."""
    try:
        yield
    except (SimulatorError, KeyboardInterrupt):
        raise
    except BaseException as error:  # SystemExit, too, and what a task has of its own
        raise SimulatorError(words.of(error)) from error
