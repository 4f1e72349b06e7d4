"""MJX environments: real steps, refits, rollouts and updates as one compiled program over the mesh."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from vecpsmbpo import health, processes
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.drivers.common import (
    COMPILED_QUICKLY,
    EpisodeKeys,
    Returns,
    Stopped,
    Stopping,
    broadcast_leaves,
    compiled,
    evaluation_actions,
    never,
    split_for_episodes,
)
from vecpsmbpo.layout import BY_SEED, SEEDS, SHARED
from vecpsmbpo.schedule import begin_stride, observe_and_learn, over_seeds, split_keys
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Counters, EpisodeEnd, Hyper, SeedState, TrainState, Transition

_LOG = PartitionSpec(None, None, SEEDS)


class ScanDriver:
    """Real steps, refits, rollouts and updates as one compiled program over the mesh."""

    def __init__(self, algorithm: Algorithm, env: Any):
        self.algorithm = algorithm
        # Traced once for all the programs that step it: of what a start costs in Python, MJX is a third.
        self._reset, self._step_env = jax.jit(env.reset), jax.jit(env.step)
        self.settings: Settings = algorithm.settings
        self.layout = algorithm.layout
        self.compile_seconds = 0.0
        specs = self.layout.specs()
        self._init = self.layout.jit_shard_map(
            self._init_local, (BY_SEED,) * 2, specs, compiler_options=COMPILED_QUICKLY
        )
        self._run = self.layout.jit_shard_map(self._run_local, (specs, SHARED), (specs, _LOG), donate_argnums=0)
        jit = self.layout.jit_shard_map
        self._start = jit(self._start_local, (specs.seeds, BY_SEED), (BY_SEED, BY_SEED))
        self._go_on = jit(self._go_on_local, (BY_SEED,) * 3, BY_SEED, donate_argnums=2)
        self._compiled: Any = None
        self._compiled_evaluation: Any = None

    def begin(self) -> None:
        pass

    def init(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        return self._init(*self.layout.everywhere((keys, hyper), BY_SEED))

    def shapes(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        return jax.eval_shape(self._init, keys, hyper)

    def compile(self, state: TrainState) -> None:
        keys = jax.eval_shape(lambda key: split_for_episodes(key, self.settings.eval_episodes), state.seeds.key)
        policies, episodes = jax.eval_shape(self._start, state.seeds, keys)
        programs = [
            (self._run, (state, jnp.int32(1))),
            (self._start, (state.seeds, keys)),
            (self._go_on, (policies, keys.actions, episodes)),
        ]
        (self._compiled, *evaluation), self.compile_seconds = compiled(programs)
        self._compiled_evaluation = evaluation

    def run(self, state: TrainState, strides: int) -> tuple[TrainState, EpisodeEnd]:
        state, log = (self._compiled or self._run)(state, self.layout.everywhere(jnp.int32(strides), SHARED))
        flat = jax.tree.map(lambda x: np.asarray(x)[:strides].reshape(-1, *x.shape[2:]), processes.here(log))
        return state, flat

    def evaluate(
        self, state: TrainState, keys: jax.Array, episodes: int, stopping: Stopping = never, unwanted: Any = None
    ) -> Returns:
        compiled_for = self._compiled_evaluation if episodes == self.settings.eval_episodes else None
        start, go_on = compiled_for or (self._start, self._go_on)
        split = self.layout.everywhere(split_for_episodes(keys, episodes), BY_SEED)
        policies, running = start(state.seeds, split)
        while processes.here(running.alive).any():
            if stopping():
                raise Stopped
            running = go_on(policies, split.actions, running)
        return Returns(*map(np.asarray, processes.here((running.total, running.length, running.broken_off))))

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
            env=jax.vmap(self._reset)(split[:, 1]),
        )

    def _run_local(self, state: TrainState, strides: jax.Array) -> tuple[TrainState, EpisodeEnd]:
        settings = self.settings

        def stride(index, carry):
            state, log = carry
            before = state.without_rings()
            state, learning = begin_stride(self.algorithm, state)
            step = lambda state, _: self._step(state, learning)  # noqa: E731
            state, news = jax.lax.scan(step, state, None, length=settings.stride)
            state, frozen = health.settle(self.layout, before, state)
            news = news.replace(done=news.done & ~frozen)
            return state, jax.tree.map(lambda all_, new: all_.at[index].set(new), log, news)

        shape = (settings.epoch_steps // settings.stride, settings.stride, state.env.obs.shape[0])
        log = EpisodeEnd.blank(shape, settings)
        return jax.lax.fori_loop(0, strides, stride, (state, log))

    def _step(self, state: TrainState, learning: jax.Array) -> tuple[TrainState, EpisodeEnd]:
        """One real step of every seed's environment, and what follows it."""
        seeds, keys = split_keys(state.seeds, 4)
        obs = state.env.obs
        action, memory = over_seeds(self.algorithm.act)(state.counters, seeds, obs, keys[:, 0])
        seeds = seeds.replace(memory=memory)
        env = jax.vmap(self._step_env)(state.env, action)
        transition = Transition(obs, action, env.reward, env.obs, env.done)
        truncated = (seeds.episode.length + 1 >= self.settings.training_limit) & (env.done == 0)
        counters, seeds, end = observe_and_learn(
            self.algorithm, state.counters, seeds, transition, truncated, keys[:, 1:3], learning
        )

        def begin_episodes(env):
            fresh = jax.vmap(self._reset)(keys[:, 3])
            return jax.tree.map(lambda new, old: jax.vmap(jnp.where)(end.done, new, old), fresh, env)

        # Not at every step: the resets of other libraries' environments cost as much as a step of physics.
        env = jax.lax.cond(jnp.any(end.done), begin_episodes, lambda env: env, env)
        return TrainState(counters, seeds, env), end

    def _start_local(self, seeds: SeedState, keys: EpisodeKeys) -> tuple[Any, "_Episodes"]:
        """The evaluation policy of every seed, leaves [S, ...], and its episodes before their first step."""

        def one_seed(seed, keys):
            count = keys.resets.shape[0]
            memory = broadcast_leaves(self.algorithm.memory(), count)
            env, zeros = jax.vmap(self._reset)(keys.resets), jnp.zeros(count)
            begun = _Episodes(
                t=jnp.int32(0),
                memory=memory,
                env=env,
                total=zeros,
                length=zeros.astype(int),
                broken_off=zeros > 0,
                alive=zeros == 0,
            )
            return self.algorithm.evaluation_policy(seed, keys.policy), begun

        return jax.vmap(one_seed)(seeds, keys)

    def _go_on_local(self, policies: Any, keys: jax.Array, episodes: "_Episodes") -> "_Episodes":
        """A stride of every episode. keys [S, E]."""

        def one_seed(policy, keys, episodes):
            end = episodes.t + self.settings.stride

            def step(now):
                action, memory = evaluation_actions(self.algorithm, policy, now.t, now.memory, now.env.obs, keys)
                env = jax.vmap(self._step_env)(now.env, action)
                sound = health.sound(now.env.obs, env.reward, env.obs)
                total = now.total + jnp.where(now.alive & sound, env.reward, 0.0)
                alive = now.alive & sound & (env.done == 0) & (now.t + 1 < self.settings.episode_length)
                broken_off = now.broken_off | (now.alive & ~sound)
                return _Episodes(now.t + 1, memory, env, total, now.length + now.alive, broken_off, alive)

            return jax.lax.while_loop(lambda now: (now.t < end) & jnp.any(now.alive), step, episodes)

        return jax.vmap(one_seed)(policies, keys, episodes)


class _Episodes(NamedTuple):
    """Evaluation episodes of a seed while they run.

    Attributes:
        t: [] int, steps so far.
        memory, env: leaves [E, ...].
        total, length: [E], returns and steps so far.
        broken_off: [E] bool, which ended because their simulator diverged.
        alive: [E] bool, which are not over.
    """

    t: jax.Array
    memory: Any
    env: Any
    total: jax.Array
    length: jax.Array
    broken_off: jax.Array
    alive: jax.Array
