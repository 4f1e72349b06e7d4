"""What both drivers share, apart from the order in which an algorithm's functions are called (`schedule`).

A chunk is a number of strides, a few steps each, decided when the program is called: one compiled program serves chunks
of any length, and how a run is cut into chunks does not change it. A stride is also what is undone in a lane where
something stops being finite (`health`): its news are none.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.layout import BY_SEED, Layout
from vecpsmbpo.types import EpisodeEnd, Hyper, TrainState

# For a program that runs once: what LLVM would make of it takes a minute of a core, without this a sixth of that.
COMPILED_QUICKLY = {"xla_backend_optimization_level": 0}


Stopping = Callable[[], bool]


class Returns(NamedTuple):
    """Of evaluation episodes, [S, E] each.

    Attributes:
        episode_return, length: of each; of one that was broken off until then.
        broken_off: bool, whether the simulator diverged, which ended it.
    """

    episode_return: np.ndarray
    length: np.ndarray
    broken_off: np.ndarray


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


class Stopped(Exception):
    """An evaluation was told to stop before its episodes were over."""


class EpisodeKeys(NamedTuple):
    """Of evaluation episodes. Resets and actions need keys of their own: what a reset splits its key into are the very
    keys that `fold_in` makes of it for the first steps.

    Shapes: policy [S], resets and actions [S, E].
    """

    policy: jax.Array
    resets: jax.Array
    actions: jax.Array


def never() -> bool:
    return False


class Driver(Protocol):
    """What `train` and `evaluate` need of a driver."""

    algorithm: Algorithm
    layout: Layout
    compile_seconds: float

    def begin(self) -> None:
        """Begins the first episodes of simulators, where these are not part of the train state; or `init` does.

        Raises:
            SimulatorError: one failed.
        """

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

    def evaluate(
        self, state: TrainState, keys: jax.Array, episodes: int, stopping: Stopping = never, unwanted: Any = None
    ) -> Returns:
        """Whole episodes of the evaluation policy, in environments of their own. keys [S].

        Args:
            stopping: is asked every few steps, in every process, whether to stop.
            unwanted: [S] bool, lanes whose returns nobody will use, so that their simulators need not be stepped.

        Raises:
            SimulatorError: one failed.
            Stopped: it was to stop.
        """

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


# ── evaluation ────────────────────────────────────────────────────────────────────────────────────────────────────


def evaluation_policies(algorithm: Algorithm) -> Callable:
    """Compiled (seeds, keys [S]) -> what `Algorithm.evaluation_action` needs of every seed, leaves [S, ...]."""
    seeds = algorithm.layout.specs().seeds
    return algorithm.layout.jit_shard_map(jax.vmap(algorithm.evaluation_policy), (seeds, BY_SEED), BY_SEED)


def evaluation_actions(
    algorithm: Algorithm, policy: Any, step: jax.Array, memory: Any, obs: jax.Array, keys: jax.Array
) -> tuple[jax.Array, Any]:
    """Actions [E, A] of the evaluation policy of one seed in E episodes, at the same step of each, and their memory.

    Args:
        memory, obs, keys: leaves [E, ...]; an episode's key, of `EpisodeKeys.actions`, serves all its steps.
    """
    keys = jax.vmap(lambda key: jax.random.fold_in(key, step))(keys)
    return jax.vmap(partial(algorithm.evaluation_action, policy, step))(memory, obs, keys)


def broadcast_leaves(tree: Any, *counts: int) -> Any:
    """Copies: leaves [...] -> [*counts, ...]."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (*counts, *x.shape)), tree)


def split_for_episodes(keys: jax.Array, episodes: int) -> EpisodeKeys:
    """Keys [S] -> one for the policy, two for each of E episodes."""
    split = jax.vmap(lambda key: jax.random.split(key, 1 + 2 * episodes))(keys)
    return EpisodeKeys(split[:, 0], split[:, 1 : 1 + episodes], split[:, 1 + episodes :])
