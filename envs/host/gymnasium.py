"""Gymnasium's tasks on their own simulators."""

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np

from vecpsmbpo.envs import specs, termination
from vecpsmbpo.envs.host import attributes
from vecpsmbpo.envs.host.batched import HostEnv, Simulator, diverged
from vecpsmbpo.envs.host.mujoco_state import MujocoState
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec, TerminationRule

EPISODE_LENGTH = 1000  # of a task that is registered without a limit


class GymnasiumSimulator(Simulator):
    """One Gymnasium environment with a vector of observations and bounded continuous actions."""

    def __init__(self, env: Any, seed: int, name: str):
        """
        Args:
            env: a `gymnasium.Env`.
            name: for errors.

        Raises:
            SettingError: observations or actions are of another kind.
        """
        _check_spaces(env, name)
        self.env = env
        self._low, self._high = env.action_space.low, env.action_space.high
        self._seed: int | None = seed
        core = env.unwrapped
        self._state = MujocoState(core.model, core.data) if _is_mujoco(core) else None

    def reset(self) -> np.ndarray:
        obs, _ = self.env.reset(seed=self._seed)
        self._seed = None  # the first reset seeds; later ones go on with the same generator
        if self._state:
            self._state.begin_episode()
        return obs

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        if self._state:
            self._state.begin_step(action)
        scaled = self._low + (action + 1) * (self._high - self._low) / 2
        obs, reward, terminated, truncated, _ = self.env.step(scaled.astype(self.env.action_space.dtype))
        if self._state and self._state.diverged:
            return diverged(len(obs))
        return obs, float(reward), bool(terminated), bool(truncated)

    def save(self) -> dict[str, Any]:
        core = self.env.unwrapped
        return {
            "seed": self._seed,
            "physics": self._state.save() if self._state else None,
            "attributes": [attributes.save(layer) for layer in layers(self.env)],
            "generator": core.np_random.bit_generator.state,
        }

    def load(self, saved: dict[str, Any]) -> None:
        self.env.reset()  # wrappers refuse a step before it
        self._seed = saved["seed"]
        core = self.env.unwrapped
        if self._state:
            action = self._state.load(saved["physics"])
            if action is not None:
                self.step(action)
        for layer, values in zip(layers(self.env), saved["attributes"], strict=True):
            attributes.load(layer, values)
        core.np_random.bit_generator.state = saved["generator"]


def layers(env: Any) -> Iterator[Any]:
    """An environment's wrappers, the outermost first, and itself."""
    while env is not env.unwrapped:
        yield env
        env = env.env
    yield env


def _is_mujoco(core: Any) -> bool:
    return hasattr(core, "model") and hasattr(core, "data") and hasattr(core.data, "qpos")


def _check_spaces(env: Any, name: str) -> None:
    obs, action = env.observation_space, env.action_space
    if not isinstance(obs, gymnasium.spaces.Box) or len(obs.shape) != 1:
        raise SettingError(f"{name}: its observations are {obs}; only vectors (Box of one dimension) can be learned")
    if not isinstance(action, gymnasium.spaces.Box) or len(action.shape) != 1:
        raise SettingError(
            f"{name}: its actions are {action}; only continuous ones (Box of one dimension) can be learned"
        )
    if not action.is_bounded():
        raise SettingError(f"{name}: its actions are {action}; they must be bounded")


def any_task(*, num_envs: int, seed: int, id: str, render_mode: str | None = None) -> HostEnv:
    """Any registered Gymnasium environment. Termination of its MuJoCo tasks is known; of others it is learned.

    Args:
        render_mode: of Gymnasium; no setting, but what `look.stage` asks for.

    Raises:
        SettingError: there is no such environment, it cannot be learned, or has no such `render_mode`.
    """
    drawn = {"render_mode": render_mode} if render_mode else {}

    def make() -> Any:
        try:
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", message=".*out of date.*")  # the paper's tasks are the v4 ones
                # No time limit of its own (-1): that is HostEnv's.
                return gymnasium.make(id, max_episode_steps=-1, disable_env_checker=True, **drawn)
        except (gymnasium.error.Error, ImportError) as error:
            raise SettingError(f"env.id={id}: {str(error).splitlines()[0]}") from None
        except TypeError as error:
            if "argument 'render_mode'" in str(error):
                raise SettingError(f"env.id={id}: cannot be drawn: it takes no render_mode") from None
            raise

    simulators = [GymnasiumSimulator(make(), seed + index, f"env.id={id}") for index in range(num_envs)]
    registered = simulators[0].env.spec.id  # `Hopper` is `Hopper-v5`
    limit = gymnasium.spec(registered).max_episode_steps or EPISODE_LENGTH
    return batch(simulators, registered, limit, termination.of_gymnasium(registered))


def batch(simulators: list[GymnasiumSimulator], name: str, limit: int, terminated: TerminationRule | None) -> HostEnv:
    """Simulators of one task, with the spec read off the first."""
    obs, action = simulators[0].env.observation_space, simulators[0].env.action_space
    return HostEnv(EnvSpec(name, obs.shape[0], action.shape[0], limit, terminated), simulators)


def original(*, num_envs: int, seed: int, name: str, id: str) -> HostEnv:
    """The environment `id` as the task `name`, which has a port."""
    return HostEnv(specs.get(name), any_task(num_envs=num_envs, seed=seed, id=id).simulators)
