"""Steps real environments with an algorithm: as one compiled program (MJX), or with a simulator on the host.

Both go through the same functions of the algorithm in the same order. A period is `model_update_every` steps: it
begins with a refresh (models refitted, imagination renewed); then every step acts, observes and learns. A chunk is a
number of strides, a few steps each, decided when the program is called: one compiled program serves chunks of any
length, and how a run is cut into chunks does not change it.
"""

import itertools
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.envs.host.batched import HostEnv
from vecpsmbpo.layout import SEEDS, Layout
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Counters, EpisodeEnd, Hyper, SeedState, TrainState, Transition

COMPILER_STACK = 64 * 2**20  # bytes

_SHARED, _BY_SEED = PartitionSpec(), PartitionSpec(SEEDS)
_LOG = PartitionSpec(None, None, SEEDS)


class Returns(NamedTuple):
    """Of evaluation episodes, [S, E] each."""

    episode_return: np.ndarray
    length: np.ndarray


class Driver(Protocol):
    """What `train` and `evaluate` need of a driver."""

    algorithm: Algorithm
    layout: Layout
    compile_seconds: float

    def init(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        """The state before the first step, laid out on the mesh. keys [S], hyper leaves [S]."""

    def compile(self, state: TrainState) -> None:
        """Builds the programs, so that the first chunk does not have to."""

    def run(self, state: TrainState, strides: int) -> tuple[TrainState, EpisodeEnd]:
        """A chunk, of an epoch at most. The state given is consumed. News have leaves [strides * stride, S, ...]."""

    def evaluate(self, state: TrainState, keys: jax.Array, episodes: int) -> Returns:
        """Whole episodes of the evaluation policy, in environments of their own. keys [S]."""

    def save_env(self) -> dict[str, Any]:
        """State of simulators that is not part of the train state, in JSON's types."""

    def load_env(self, saved: dict[str, Any]) -> None:
        """The inverse of `save_env`."""


# ── what both drivers run, for this device's share ───────────────────────────────────────────────────────────────


def over_seeds(function: Callable) -> Callable:
    """`function` of (counters, state of one seed, ...) for every seed of this device; counters are shared."""

    def batched(counters, *args):
        return jax.vmap(lambda *one: function(counters, *one))(*args)

    return batched


def begin_stride(algorithm: Algorithm, state: TrainState) -> tuple[TrainState, jax.Array]:
    """Refreshes models and imagined data where a period begins, and says whether this period learns: not before the
    warm-up is over.

    Where every seed learns from real data alone (λ = 1, equation 15), models are not needed and not
    fitted.
    """
    counters, seeds = state.counters, state.seeds
    into_period = counters.env_steps % algorithm.settings.model_update_every
    learning = counters.env_steps - into_period >= algorithm.settings.warmup_steps
    advanced, keys = split_keys(seeds, 2)
    seeds = seeds.replace(key=jnp.where(into_period == 0, advanced.key, seeds.key))
    seeds = over_seeds(algorithm.begin_epoch)(counters, seeds, keys[:, 0])
    only_real = over_seeds(algorithm.real_ratio)(counters, seeds) >= 1
    imagining = (into_period == 0) & learning & algorithm.layout.any_seed(~only_real)
    seeds = over_seeds(lambda c, s, k: algorithm.refresh(c, s, imagining, k))(counters, seeds, keys[:, 1])
    counters = counters._replace(imagined_rows=algorithm.imagined_rows(counters, imagining))
    return state.replace(counters=counters, seeds=seeds), learning


def split_keys(seeds: SeedState, count: int) -> tuple[SeedState, jax.Array]:
    """Takes `count` keys [S, count] from every seed's own."""
    keys = jax.vmap(lambda key: jax.random.split(key, count + 1))(seeds.key)
    return seeds.replace(key=keys[:, 0]), keys[:, 1:]


def observe_and_learn(
    algorithm: Algorithm,
    counters: Counters,
    seeds: SeedState,
    transition: Transition,
    truncated: jax.Array,
    keys: jax.Array,
    learning: jax.Array,
) -> tuple[Counters, SeedState, EpisodeEnd]:
    """What follows every real step. transition leaves [S, ...], truncated [S], keys [S, 2]."""
    seeds, end = over_seeds(algorithm.observe)(counters, seeds, transition, truncated, keys[:, 0])
    counters = counters._replace(env_steps=counters.env_steps + 1)
    # Only the agents go through the branch: a conditional that returned the buffers would copy them.
    agents = jax.lax.cond(
        learning,
        lambda seeds: over_seeds(algorithm.learn)(counters, seeds, keys[:, 1]),
        lambda seeds: seeds.agents,
        seeds,
    )
    return counters, seeds.replace(agents=agents), end


def greedily(
    algorithm: Algorithm, policy: Any, step: jax.Array, memory: Any, obs: jax.Array, keys: jax.Array
) -> tuple[jax.Array, Any]:
    """Actions [E, A] of the evaluation policy of one seed in E episodes, at the same step of each, and their memory.

    Args:
        memory, obs, keys: leaves [E, ...]; an episode's key serves all its steps.
    """
    keys = jax.vmap(lambda key: jax.random.fold_in(key, step))(keys)
    return jax.vmap(partial(algorithm.act_greedily, policy, step))(memory, obs, keys)


# ── MJX: everything in one program ───────────────────────────────────────────────────────────────────────────────


class ScanDriver:
    """Real steps, refits, rollouts and updates as one compiled program over the mesh."""

    def __init__(self, algorithm: Algorithm, env: Any):
        self.algorithm, self.env = algorithm, env
        self.settings: Settings = algorithm.settings
        self.layout = algorithm.layout
        self.compile_seconds = 0.0
        specs = self.layout.specs()
        self._init = self.layout.spread(self._init_local, (_BY_SEED, _BY_SEED), specs)
        self._run = self.layout.spread(self._run_local, (specs, _SHARED), (specs, _LOG), donate_argnums=0)
        self._evaluate = self.layout.spread(self._evaluate_local, (specs.seeds, _BY_SEED), (_BY_SEED, _BY_SEED))
        self._compiled: Any = None
        self._compiled_evaluate: Any = None

    def init(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        return self._init(keys, hyper)

    def compile(self, state: TrainState) -> None:
        began = time.perf_counter()
        keys = jax.eval_shape(lambda key: _split(key, self.settings.eval_episodes), state.seeds.key)
        lowered = (self._run.lower(state, jnp.int32(1)), self._evaluate.lower(state.seeds, keys))
        # XLA compiles outside of Python's lock: together they cost the longer one. It recurses deeper than a thread's
        # usual stack allows (jax 0.11.2 crashes).
        usual = threading.stack_size(COMPILER_STACK)
        with ThreadPoolExecutor() as pool:
            self._compiled, self._compiled_evaluate = pool.map(lambda program: program.compile(), lowered)
        threading.stack_size(usual)
        self.compile_seconds = time.perf_counter() - began

    def run(self, state: TrainState, strides: int) -> tuple[TrainState, EpisodeEnd]:
        state, log = (self._compiled or self._run)(state, jnp.int32(strides))
        flat = jax.tree.map(lambda x: np.asarray(x)[:strides].reshape(-1, *x.shape[2:]), log)
        return state, flat

    def evaluate(self, state: TrainState, keys: jax.Array, episodes: int) -> Returns:
        program = self._compiled_evaluate if episodes == self.settings.eval_episodes else None
        return Returns(*map(np.asarray, (program or self._evaluate)(state.seeds, _split(keys, episodes))))

    def save_env(self) -> dict[str, Any]:
        return {}  # the environments are part of the train state

    def load_env(self, saved: dict[str, Any]) -> None:
        pass

    def _init_local(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        split = jax.vmap(jax.random.split)(keys)
        counters = Counters(env_steps=jnp.int32(0), imagined_rows=jnp.int32(0))
        return TrainState(
            counters=counters,
            seeds=jax.vmap(self.algorithm.init)(split[:, 0], hyper),
            env=jax.vmap(self.env.reset)(split[:, 1]),
        )

    def _run_local(self, state: TrainState, strides: jax.Array) -> tuple[TrainState, EpisodeEnd]:
        settings = self.settings

        def stride(index, carry):
            state, log = carry
            state, learning = begin_stride(self.algorithm, state)
            step = lambda state, _: self._step(state, learning)  # noqa: E731
            state, news = jax.lax.scan(step, state, None, length=settings.stride)
            return state, jax.tree.map(lambda all_, new: all_.at[index].set(new), log, news)

        shape = (settings.epoch_steps // settings.stride, settings.stride, state.env.obs.shape[0])
        log = EpisodeEnd.blank(shape, settings.n_members)
        return jax.lax.fori_loop(0, strides, stride, (state, log))

    def _step(self, state: TrainState, learning: jax.Array) -> tuple[TrainState, EpisodeEnd]:
        """One real step of every seed's environment, and what follows it."""
        seeds, keys = split_keys(state.seeds, 4)
        obs = state.env.obs
        action, memory = over_seeds(self.algorithm.act)(state.counters, seeds, obs, keys[:, 0])
        seeds = seeds.replace(memory=memory)
        env = jax.vmap(self.env.step)(state.env, action)
        transition = Transition(obs, action, env.reward, env.obs, env.done)
        truncated = (seeds.episode.length + 1 >= self.settings.episode_length) & (env.done == 0)
        counters, seeds, end = observe_and_learn(
            self.algorithm, state.counters, seeds, transition, truncated, keys[:, 1:3], learning
        )

        def begin_episodes(env):
            fresh = jax.vmap(self.env.reset)(keys[:, 3])
            return jax.tree.map(lambda new, old: jax.vmap(jnp.where)(end.done, new, old), fresh, env)

        # Not at every step: the resets of other libraries' environments cost as much as a step of physics.
        env = jax.lax.cond(jnp.any(end.done), begin_episodes, lambda env: env, env)
        return TrainState(counters, seeds, env), end

    def _evaluate_local(self, seeds: SeedState, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one_seed(seed, keys):
            policy = self.algorithm.evaluation_policy(seed, keys[0])

            def step(carry):
                t, memory, env, total, length, alive = carry
                action, memory = greedily(self.algorithm, policy, t, memory, env.obs, keys[1:])
                env = jax.vmap(self.env.step)(env, action)
                total = total + jnp.where(alive, env.reward, 0.0)
                return t + 1, memory, env, total, length + alive, alive & (env.done == 0)

            def running(carry):
                t, *_, alive = carry
                return (t < self.settings.episode_length) & jnp.any(alive)

            count = keys.shape[0] - 1
            start = jax.vmap(self.env.reset)(keys[1:])
            memory = many(self.algorithm.memory(), count)
            carry = (0, memory, start, jnp.zeros(count), jnp.zeros(count, jnp.int32), jnp.ones(count, bool))
            *_, total, length, _ = jax.lax.while_loop(running, step, carry)
            return total, length

        return jax.vmap(one_seed)(seeds, keys)


def many(tree: Any, *counts: int) -> Any:
    """Copies: leaves [...] -> [*counts, ...]."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*counts, *x.shape)), tree)


def _split(keys: jax.Array, episodes: int) -> jax.Array:
    """Keys [S] -> [S, 1 + E]: one for the policy, one for each episode."""
    return jax.vmap(lambda key: jax.random.split(key, 1 + episodes))(keys)


# ── a simulator on the host ──────────────────────────────────────────────────────────────────────────────────────


class HostDriver:
    """The same functions, jitted one by one, with a simulator stepped between them."""

    def __init__(self, algorithm: Algorithm, make_env: Callable[..., HostEnv]):
        """
        Args:
            make_env: (num_envs, seed) -> the batched environment.
        """
        self.algorithm = algorithm
        self.settings: Settings = algorithm.settings
        self.layout = algorithm.layout
        self.compile_seconds = 0.0
        self._make_env = make_env
        self._env = make_env(num_envs=self.layout.num_seeds, seed=self.settings.seed)
        self._env.episode_length = self.settings.episode_length
        specs, seeds = self.layout.specs(), self.layout.specs().seeds
        spread = self.layout.spread
        self._init = spread(self._init_local, (_BY_SEED, _BY_SEED, _BY_SEED), specs)
        self._begin = spread(lambda state: begin_stride(algorithm, state), (specs,), (specs, _SHARED), donate_argnums=0)
        self._act = spread(self._act_local, (specs.counters, seeds, _BY_SEED), (_BY_SEED, _BY_SEED, _BY_SEED))
        self._observe = spread(
            self._observe_local,
            (specs, _BY_SEED, _BY_SEED, _BY_SEED, _BY_SEED, _BY_SEED, _SHARED),
            (specs, _BY_SEED),
            donate_argnums=0,
        )
        self._policy = spread(jax.vmap(algorithm.evaluation_policy), (seeds, _BY_SEED), _BY_SEED)
        self._act_greedily = spread(
            jax.vmap(partial(greedily, algorithm), in_axes=(0, None, 0, 0, 0)),
            (_BY_SEED, _SHARED, _BY_SEED, _BY_SEED, _BY_SEED),
            (_BY_SEED, _BY_SEED),
        )

    def init(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        return self._init(keys, hyper, jnp.asarray(self._env.reset()))

    def compile(self, state: TrainState) -> None:
        pass  # each function is compiled when it is first needed

    def run(self, state: TrainState, strides: int) -> tuple[TrainState, EpisodeEnd]:
        news = []
        for _ in range(strides):
            state, learning = self._begin(state)
            for _ in range(self.settings.stride):
                state, end = self._step(state, learning)
                news.append(end)
        return state, jax.tree.map(lambda *xs: np.stack(xs), *news)

    def _step(self, state: TrainState, learning: jax.Array) -> tuple[TrainState, EpisodeEnd]:
        obs = state.env
        action, memory, keys = self._act(state.counters, state.seeds, obs)
        step = self._env.step(np.asarray(action))
        terminated = step.terminated.astype(np.float32)
        transition = Transition(*map(jnp.asarray, (obs, action, step.reward, step.next_obs, terminated)))
        state, end = self._observe(state, memory, transition, step.truncated, keys, step.obs, learning)
        return state, jax.tree.map(np.asarray, end)

    def evaluate(self, state: TrainState, keys: jax.Array, episodes: int) -> Returns:
        seeds, obs_size = self.layout.num_seeds, self.algorithm.spec.obs_size
        split = _split(keys, episodes)
        policy = self._policy(state.seeds, split[:, 0])
        env_seed = int(jax.random.randint(split[0, 1], (), 0, 2**30))
        env = self._make_env(num_envs=seeds * episodes, seed=env_seed)
        env.episode_length = self.settings.episode_length
        obs = env.reset()
        count = seeds * episodes
        memory = many(self.algorithm.memory(), seeds, episodes)
        total, length, alive = np.zeros(count), np.zeros(count, int), np.ones(count, bool)
        for t in itertools.count():
            if not alive.any():
                break
            states = obs.reshape(seeds, episodes, obs_size)
            action, memory = self._act_greedily(policy, jnp.int32(t), memory, states, split[:, 1:])
            step = env.step(np.asarray(action).reshape(count, -1))
            obs = step.obs
            total += np.where(alive, step.reward, 0.0)
            length += alive
            alive &= ~(step.terminated | step.truncated)
        return Returns(total.reshape(seeds, episodes), length.reshape(seeds, episodes))

    def save_env(self) -> dict[str, Any]:
        return self._env.save()

    def load_env(self, saved: dict[str, Any]) -> None:
        self._env.load(saved)

    def _init_local(self, keys: jax.Array, hyper: Hyper, obs: jax.Array) -> TrainState:
        counters = Counters(env_steps=jnp.int32(0), imagined_rows=jnp.int32(0))
        return TrainState(counters, jax.vmap(self.algorithm.init)(keys, hyper), obs)

    def _act_local(self, counters: Counters, seeds: SeedState, obs: jax.Array) -> tuple[jax.Array, Any, jax.Array]:
        # The key is not advanced here but in `_observe_local`, which splits the same one: acting needs no copy of
        # the state, and changes nothing.
        _, keys = split_keys(seeds, 3)
        return *over_seeds(self.algorithm.act)(counters, seeds, obs, keys[:, 0]), keys[:, 1:]

    def _observe_local(
        self,
        state: TrainState,
        memory: Any,
        transition: Transition,
        truncated: jax.Array,
        keys: jax.Array,
        obs: jax.Array,
        learning: jax.Array,
    ) -> tuple[TrainState, EpisodeEnd]:
        seeds, _ = split_keys(state.seeds.replace(memory=memory), 3)
        counters, seeds, end = observe_and_learn(
            self.algorithm, state.counters, seeds, transition, truncated, keys, learning
        )
        return TrainState(counters, seeds, obs), end
