"""Simulators on the host: the program is cut where they are stepped. `_begin` begins a stride and acts; after each step
`_follow` observes, learns and acts again; `_settle` ends the stride.
"""

import itertools
import zlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from vecpsmbpo import health, processes
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.drivers.common import (
    COMPILED_QUICKLY,
    Interrupted,
    Returns,
    Stopped,
    Stopping,
    broadcast_leaves,
    compiled,
    evaluation_actions,
    evaluation_policies,
    never,
    split_for_episodes,
)
from vecpsmbpo.envs.host.batched import HostEnv, HostStep, SimulatorError
from vecpsmbpo.layout import BY_SEED, SHARED
from vecpsmbpo.schedule import begin_stride, observe_and_learn, over_seeds, split_keys
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.types import Counters, EpisodeEnd, Hyper, TrainState, Transition

T = TypeVar("T")
NUMBERS = 3  # of a step, before its observations: reward, terminated, truncated


class Acted(NamedTuple):
    """An action in every seed's environment, and what acting has changed, which is kept beside the state until the step
    is observed: acting needs no copy of the state.

    Attributes:
        action: [S, A].
        memory: of the algorithm, leaves [S, ...].
        key: [S] the seeds' own from now on.
        keys: [S, 2] to observe and to learn with.
    """

    action: jax.Array
    memory: Any
    key: jax.Array
    keys: jax.Array


class HostDriver:
    """The functions of the algorithm, jitted in parts, with a simulator stepped between them."""

    def __init__(self, algorithm: Algorithm, env: HostEnv, make_env: Callable[..., HostEnv]):
        """
        Args:
            env: one simulator per seed.
            make_env: (num_envs, seed) -> others of the same task, to evaluate in.
        """
        self.algorithm = algorithm
        self.settings: Settings = algorithm.settings
        self.layout = algorithm.layout
        self.compile_seconds = 0.0
        self._make_env = make_env
        self._env = env
        self._env.episode_length = self.settings.training_limit
        specs = self.layout.specs()
        jit, before = self.layout.jit_shard_map, specs.without_rings()
        self._init = jit(self._init_local, (BY_SEED,) * 3, specs, compiler_options=COMPILED_QUICKLY)
        self._begin = jit(self._begin_local, (specs,), (before, specs, SHARED, BY_SEED), donate_argnums=0)
        self._follow = jit(
            self._follow_local,
            (specs, BY_SEED, BY_SEED, SHARED),
            (specs, BY_SEED, BY_SEED),
            donate_argnums=0,
        )
        self._settle = jit(partial(health.settle, self.layout), (before, specs), (specs, BY_SEED), donate_argnums=1)
        self._policies = evaluation_policies(algorithm)
        self._evaluation_actions = jit(
            jax.vmap(partial(evaluation_actions, algorithm), in_axes=(0, None, 0, 0, 0)),
            (BY_SEED, SHARED, BY_SEED, BY_SEED, BY_SEED),
            (BY_SEED, BY_SEED),
        )
        self._compiled_evaluation_actions: Any = None
        self._saved_env: dict[str, Any] | None = None  # as the running stride began
        self._first_obs: np.ndarray | None = None  # from `begin` to `init`

    def begin(self) -> None:
        self._first_obs = _in_all(self._env.reset)

    def init(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        if self._first_obs is None:
            self.begin()
        obs, self._first_obs = jnp.asarray(self._first_obs), None
        return self._init(*self.layout.everywhere((keys, hyper, obs), BY_SEED))

    def shapes(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        return jax.eval_shape(self._init, keys, hyper, self._shape(self.algorithm.spec.obs_size))

    def compile(self, state: TrainState) -> None:
        spec, seeds, episodes = self.algorithm.spec, self.layout.num_lanes, self.settings.eval_episodes
        before, _, learning, acted = jax.eval_shape(self._begin, state)
        stepped = self._shape(NUMBERS + 2 * spec.obs_size)
        episode_keys = jax.eval_shape(lambda key: split_for_episodes(key, episodes).actions, state.seeds.key)
        policies = jax.eval_shape(self._policies, state.seeds, state.seeds.key)
        remembered = jax.eval_shape(lambda: broadcast_leaves(self.algorithm.memory(), seeds, episodes))
        states = self._shape(episodes, spec.obs_size)
        programs = [
            (self._begin, (state,)),
            (self._follow, (state, acted, stepped, learning)),
            (self._settle, (before, state)),
            (self._policies, (state.seeds, state.seeds.key)),
            (self._evaluation_actions, (policies, jnp.int32(0), remembered, states, episode_keys)),
        ]
        executables, self.compile_seconds = compiled(programs)
        self._begin, self._follow, self._settle, self._policies, actions = executables
        self._compiled_evaluation_actions = actions

    def run(self, state: TrainState, strides: int) -> tuple[TrainState, EpisodeEnd]:
        news: list[EpisodeEnd] = []
        frozen = np.asarray(health.frozen(processes.here(state.seeds.health)))
        for _ in range(strides):
            self._saved_env = self._env.save()
            before, state, learning, acted = self._begin(state)
            ends: list[EpisodeEnd] = []
            try:
                for _ in range(self.settings.stride):
                    state, end, acted = self._follow(state, acted, self._step(acted.action, frozen), learning)
                    ends.append(end)
            except SimulatorError as error:
                # Rows that were written to the rings lie beyond the counters, and will be written again.
                step = int(before.counters.env_steps) + len(ends) + 1
                whole = before.replace(seeds=before.seeds.replace(**state.seeds.rings()))
                raise Interrupted(step, whole, _stacked(news), error) from error
            state, frozen = self._settle(before, state)
            # Of the whole stride at once: to fetch what a step returns would be nine waits for the device at each.
            ends, frozen = jax.tree.map(np.asarray, processes.here((ends, frozen)))
            news += [end.replace(done=end.done & ~frozen) for end in ends]
        self._saved_env = None
        self._check_alike()
        return state, _stacked(news)

    def _check_alike(self) -> None:
        """Every process steps simulators of its own, and feeds its devices what it has seen.

        Raises:
            SettingError: they have not seen the same.
        """
        if processes.are_several() and not processes.agree(zlib.crc32(repr(self._env.save()).encode()) & 0x7FFFFFFF):
            raise SettingError(
                f"distributed: the simulators of {self.settings.task} are not in the same state in all processes: they "
                "depend on more than their seeds and actions"
            )

    def _step(self, action: jax.Array, frozen: np.ndarray) -> jax.Array:
        """Steps the simulators of all lanes but the frozen ones; what they say, packed."""
        step = _in_all(partial(self._env.step, np.asarray(processes.here(action)), still=frozen))
        return self.layout.everywhere(_packed(step), BY_SEED)

    def evaluate(
        self, state: TrainState, keys: jax.Array, episodes: int, stopping: Stopping = never, unwanted: Any = None
    ) -> Returns:
        seeds, obs_size = self.layout.num_lanes, self.algorithm.spec.obs_size
        split = split_for_episodes(keys, episodes)
        env_seed = int(jax.random.randint(split.resets[0, 0], (), 0, 2**30))
        split = self.layout.everywhere(split, BY_SEED)
        policies = self._policies(state.seeds, split.policy)
        env = _in_all(partial(self._others, seeds * episodes, env_seed))
        obs = _in_all(env.reset)
        compiled_for = self._compiled_evaluation_actions if episodes == self.settings.eval_episodes else None
        act, count = compiled_for or self._evaluation_actions, seeds * episodes
        memory = self.layout.everywhere(broadcast_leaves(self.algorithm.memory(), seeds, episodes), BY_SEED)
        total, length, broken_off = np.zeros(count), np.zeros(count, int), np.zeros(count, bool)
        alive = np.ones(count, bool) if unwanted is None else np.repeat(~unwanted, episodes)
        for t in itertools.count():
            if not alive.any():
                break
            if t % self.settings.stride == 0 and stopping():
                raise Stopped
            states = self.layout.everywhere(obs.reshape(seeds, episodes, obs_size), BY_SEED)
            now = self.layout.everywhere(jnp.int32(t), SHARED)
            action, memory = act(policies, now, memory, states, split.actions)
            step = _in_all(partial(env.step, np.asarray(processes.here(action)).reshape(count, -1), still=~alive))
            obs = step.obs
            total += np.where(alive & step.sound, step.reward, 0.0)
            length += alive
            broken_off |= alive & ~step.sound
            alive &= ~(step.terminated | step.truncated)
        return Returns(*(x.reshape(seeds, episodes) for x in (total, length, broken_off)))

    def _others(self, num_envs: int, seed: int) -> HostEnv:
        """Environments to evaluate in.

        Raises:
            SimulatorError: they cannot be made, though those to train in could.
        """
        try:
            env = self._make_env(num_envs=num_envs, seed=seed)
        except SettingError as error:
            raise SimulatorError(str(error)) from error
        env.episode_length = self.settings.episode_length
        return env

    def save_env(self) -> dict[str, Any]:
        return self._saved_env or self._env.save()

    def load_env(self, saved: dict[str, Any]) -> None:
        self._env.load(saved)

    def _shape(self, *size: int) -> Any:
        """Of float32 numbers [S, *size]."""
        return jax.ShapeDtypeStruct((self.layout.num_lanes, *size), jnp.float32)

    def _init_local(self, keys: jax.Array, hyper: Hyper, obs: jax.Array) -> TrainState:
        counters = Counters(env_steps=jnp.int32(0), imagined_rows=jnp.int32(0))
        return TrainState(counters, jax.vmap(self.algorithm.init)(keys, hyper), obs)

    def _begin_local(self, state: TrainState) -> tuple[TrainState, TrainState, jax.Array, Acted]:
        begun, learning = begin_stride(self.algorithm, state)
        return state.without_rings(), begun, learning, self._act(begun)

    def _act(self, state: TrainState) -> Acted:
        advanced, keys = split_keys(state.seeds, 3)
        action, memory = over_seeds(self.algorithm.act)(state.counters, state.seeds, state.env, keys[:, 0])
        return Acted(action, memory, advanced.key, keys[:, 1:])

    def _follow_local(
        self, state: TrainState, acted: Acted, stepped: jax.Array, learning: jax.Array
    ) -> tuple[TrainState, EpisodeEnd, Acted]:
        """What follows a step of the simulators, and the next action where the stride goes on: another one begins with
        an action of its own."""
        reward, terminated, truncated, next_obs, obs = _unpacked(stepped)
        transition = Transition(state.env, acted.action, reward, next_obs, terminated)
        counters, seeds, end = observe_and_learn(
            self.algorithm,
            state.counters,
            state.seeds.replace(memory=acted.memory, key=acted.key),
            transition,
            truncated,
            acted.keys,
            learning,
        )
        state = TrainState(counters, seeds, obs)
        goes_on = counters.env_steps % self.settings.stride != 0
        return state, end, jax.lax.cond(goes_on, self._act, lambda _: acted, state)


def _in_all(call: Callable[[], T]) -> T:
    """A call of the simulators, which fails in all processes of the run where it fails in one.

    Raises:
        SimulatorError: it has failed here, or in another one.
    """
    failed: SimulatorError | None = None
    try:
        result = call()
    except SimulatorError as error:
        failed = error
    if processes.greatest(int(failed is not None)):
        raise failed or SimulatorError("its simulator failed in another process of the run, which says how")
    return result


def _packed(step: HostStep) -> np.ndarray:
    """What a step says as one array, [S, NUMBERS + 2 O]: a call of a program is given one instead of five."""
    columns = (step.reward, step.terminated, step.truncated, step.next_obs, step.obs)
    return np.column_stack(columns).astype(np.float32)


def _unpacked(stepped: jax.Array) -> tuple[jax.Array, ...]:
    """Reward, terminated and truncated, [S] each; the true successors and what is observed next, [S, O] each."""
    reward, terminated, truncated = jnp.moveaxis(stepped[:, :NUMBERS], 1, 0)
    return reward, terminated, truncated > 0, *jnp.split(stepped[:, NUMBERS:], 2, axis=1)


def _stacked(news: list[EpisodeEnd]) -> Any:
    """News of steps, leaves [S, ...] each, as those of a chunk, [T, S, ...]; None of none."""
    return jax.tree.map(lambda *xs: np.stack(xs), *news) if news else None
