"""What both drivers share: the order in which an algorithm's functions are called, and what a driver can do.

A period is `model_update_every` steps: it begins with a refresh (models refitted, imagination renewed); then every step
acts, observes and learns. A chunk is a number of strides, a few steps each, decided when the program is called: one
compiled program serves chunks of any length, and how a run is cut into chunks does not change it. A stride is also what
is undone in a lane where something stops being finite (`health`): its news are none.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import PartitionSpec

from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.layout import SEEDS, Layout
from vecpsmbpo.types import Counters, EpisodeEnd, Hyper, SeedState, TrainState, Transition

SHARED, BY_SEED = PartitionSpec(), PartitionSpec(SEEDS)

# For a program that runs once: what LLVM would make of it takes a minute of a core, without this a sixth of that.
COMPILED_QUICKLY = {"xla_backend_optimization_level": 0}


class Returns(NamedTuple):
    """Of evaluation episodes, [S, E] each."""

    episode_return: np.ndarray
    length: np.ndarray


class Interrupted(Exception):
    """A simulator failed in a chunk.

    Attributes:
        step: the environment step that it failed at.
        state: as the stride began that this step is in; `save_env` is of that moment, too.
        news: of the strides before, as `Driver.run` gives them; None: it was in the first.
    """

    def __init__(self, step: int, state: TrainState, news: EpisodeEnd | None, why: Exception):
        super().__init__(str(why))
        self.step, self.state, self.news = step, state, news


class EpisodeKeys(NamedTuple):
    """Of evaluation episodes. Resets and actions need keys of their own: what a reset splits its key into are the very
    keys that `fold_in` makes of it for the first steps.

    Shapes: policy [S], resets and actions [S, E].
    """

    policy: jax.Array
    resets: jax.Array
    actions: jax.Array


class Driver(Protocol):
    """What `train` and `evaluate` need of a driver."""

    algorithm: Algorithm
    layout: Layout
    compile_seconds: float

    def init(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        """The state before the first step, laid out on the mesh. keys [S], hyper leaves [S]."""

    def shapes(self, keys: jax.Array, hyper: Hyper) -> TrainState:
        """What `init` would give, as shapes; nothing is allocated and no simulator is moved."""

    def compile(self, state: TrainState) -> None:
        """Builds the programs, so that the first chunk does not have to."""

    def run(self, state: TrainState, strides: int) -> tuple[TrainState, EpisodeEnd]:
        """A chunk, of an epoch at most. The state given is consumed. News have leaves [strides * stride, S, ...]; there
        are none of frozen lanes.

        Raises:
            Interrupted: a simulator failed.
        """

    def evaluate(self, state: TrainState, keys: jax.Array, episodes: int) -> Returns:
        """Whole episodes of the evaluation policy, in environments of their own. keys [S]."""

    def save_env(self) -> dict[str, Any]:
        """State of simulators that is not part of the train state, in JSON's types."""

    def load_env(self, saved: dict[str, Any]) -> None:
        """The inverse of `save_env`."""


def compiled(programs: Sequence[tuple[Any, tuple]]) -> tuple[list[Any], float]:
    """Jitted functions and the arguments (or shapes) of each, compiled at once; and the seconds it took.

    XLA compiles outside of Python's lock: together they cost the longest one.
    """
    began = time.perf_counter()
    lowered = [program.lower(*arguments) for program, arguments in programs]
    with ThreadPoolExecutor() as pool:
        executables = list(pool.map(lambda program: program.compile(), lowered))
    return executables, time.perf_counter() - began


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
    advanced, keys = split_keys(seeds, 1)
    seeds = seeds.replace(key=jnp.where(into_period == 0, advanced.key, seeds.key))
    seeds = over_seeds(algorithm.begin_epoch)(counters, seeds)
    needed = algorithm.layout.any_seed(over_seeds(algorithm.imagines)(counters, seeds))
    imagining = (into_period == 0) & learning & needed
    seeds = over_seeds(lambda c, s, k: algorithm.refresh(c, s, imagining, k))(counters, seeds, keys[:, 0])
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


def evaluation_policies(algorithm: Algorithm) -> Callable:
    """Compiled (seeds, keys [S]) -> what `Algorithm.evaluation_action` needs of every seed, leaves [S, ...]."""
    seeds = algorithm.layout.specs().seeds
    return algorithm.layout.spread(jax.vmap(algorithm.evaluation_policy), (seeds, BY_SEED), BY_SEED)


def evaluation_actions(
    algorithm: Algorithm, policy: Any, step: jax.Array, memory: Any, obs: jax.Array, keys: jax.Array
) -> tuple[jax.Array, Any]:
    """Actions [E, A] of the evaluation policy of one seed in E episodes, at the same step of each, and their memory.

    Args:
        memory, obs, keys: leaves [E, ...]; an episode's key, of `EpisodeKeys.actions`, serves all its steps.
    """
    keys = jax.vmap(lambda key: jax.random.fold_in(key, step))(keys)
    return jax.vmap(partial(algorithm.evaluation_action, policy, step))(memory, obs, keys)


def many(tree: Any, *counts: int) -> Any:
    """Copies: leaves [...] -> [*counts, ...]."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*counts, *x.shape)), tree)


def split_for_episodes(keys: jax.Array, episodes: int) -> EpisodeKeys:
    """Keys [S] -> one for the policy, two for each of E episodes."""
    split = jax.vmap(lambda key: jax.random.split(key, 1 + 2 * episodes))(keys)
    return EpisodeKeys(split[:, 0], split[:, 1 : 1 + episodes], split[:, 1 + episodes :])
