"""Fresh episodes of the task that a run learned: what its models and critics are measured against."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from vecpsmbpo import envs
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import possible

Array = np.ndarray
_RESETS = 2**31 - 1  # of keys: no step of an episode
# (step from 0, obs [E, O], key) -> actions [E, A] and their log-densities [E].
Act = Callable[[int, Array, jax.Array], tuple[Any, Any]]


class Episodes(NamedTuple):
    """E episodes of up to T steps. What comes after an end is zero and not `there`.

    Attributes:
        obs, next_obs: [E, T, O].
        action: [E, T, A].
        log_prob: [E, T], of the actions taken.
        reward: [E, T].
        terminated: [E, T] bool, at the step that terminates.
        there: [E, T] bool.
    """

    obs: Array
    action: Array
    log_prob: Array
    reward: Array
    next_obs: Array
    terminated: Array
    there: Array


class Step(NamedTuple):
    """next_obs [E, O], reward [E], terminated [E], truncated [E]; and obs [E, O] to go on from."""

    next_obs: Array
    reward: Array
    terminated: Array
    truncated: Array
    obs: Array


class World(Protocol):
    """E environments of one task, stepped together.

    Attributes:
        length: the most steps of an episode.
    """

    length: int

    def reset(self) -> Array:
        """[E, O]."""

    def rewind(self) -> None:
        """The next reset begins as the first did, where starts can be chosen."""

    def step(self, action: Array) -> Step: ...


@lru_cache(maxsize=1)
def _programs(env: Any) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Reset and step of a batch of an environment, compiled once for all worlds of it."""
    return jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


class MjxWorld:
    """MJX environments. One whose episode is over goes on: nobody looks at it any more."""

    def __init__(self, env: Any, count: int, seed: int, length: int = 0):
        self._seed, self._count, self.length = seed, count, length or env.spec.episode_length
        self.rewind()
        self._reset, self._step = _programs(env)
        self.state: Any = None  # leaves [E, ...]

    def rewind(self) -> None:
        # Folded: whoever acts here draws with what `fold_in` makes of the seed's key and a step, and the parts that
        # `split` makes of a key are the same as those of its first steps.
        self._key = jax.random.fold_in(jax.random.key(self._seed), _RESETS)

    def reset(self) -> Array:
        self._key, key = jax.random.split(self._key)  # episodes that follow one another begin differently
        self.state = self._reset(jax.random.split(key, self._count))
        return np.asarray(self.state.obs)

    def step(self, action: Array) -> Step:
        self.state = self._step(self.state, action)
        obs, reward, done = (np.asarray(x) for x in (self.state.obs, self.state.reward, self.state.done))
        return Step(obs, reward, done > 0, np.zeros(len(done), bool), obs)


class HostWorld:
    """Simulators on the host."""

    def __init__(self, env: HostEnv, length: int):
        self._env = env
        self.length = env.episode_length = length or env.spec.episode_length

    def reset(self) -> Array:
        return self._env.reset()

    def rewind(self) -> None:
        pass

    def step(self, action: Array) -> Step:
        step = self._env.step(action)
        return Step(step.next_obs, step.reward, step.terminated, step.truncated, step.obs)


def world(settings: Settings, count: int, length: int, seed: int) -> World:
    """`count` environments of a run's task on the run's backend, for episodes of up to `length` steps, or where that is
    0 the task's own limit.

    Raises:
        SettingError: the task's suite is not installed.
    """
    env = envs.make(settings.env, settings.backend, num_envs=count, seed=seed, **dict(settings.env_options))
    return MjxWorld(env, count, seed, length) if settings.backend == "mjx" else HostWorld(env, length)


def collect(
    world: World, act: Act, length: int, key: jax.Array, *, each: Callable[[Any], Any] = lambda steps: steps
) -> Episodes:
    """An episode of up to `length` steps in every environment.

    Args:
        each: shows progress over the steps, as `rich.progress.track` does.
    """
    obs, columns = world.reset(), []
    alive = possible(obs).all(axis=-1)
    for t in each(range(length)):
        seen = np.where(possible(obs), obs, 0).astype(obs.dtype)
        action, log_prob = (np.asarray(x) for x in act(t, seen, jax.random.fold_in(key, t)))
        step = world.step(action)
        # A step in which the simulator diverged is not believed, and ends the episode before it.
        alive = alive & possible(step.reward) & possible(step.next_obs).all(axis=-1)
        taken = (obs, action, log_prob, step.reward, step.next_obs, step.terminated)
        columns.append([*map(partial(_where, alive), taken), alive])
        alive = alive & ~step.terminated & ~step.truncated
        obs = step.obs
    return Episodes(*(np.stack(column, axis=1) for column in zip(*columns, strict=True)))


def _where(alive: Array, values: Array) -> Array:
    """Zero where not `alive` [E]."""
    return np.where(alive.reshape(-1, *[1] * (values.ndim - 1)), values, 0).astype(values.dtype)
