"""Algorithm 1 in time: what begins a period and what follows a step, for every seed of this device.

The paper's lines, and where they are:

    1       an episode ends and another begins            Algorithm.observe
    2       models are trained on D_E                     Algorithm.fit_models    ┐ in `refresh`, where a period
    8-10    every member is rolled out in its model       PsMbpo.imagine          ┘ of `model_update_every` steps begins
    3       who acts                                      Algorithm.draw          (when an episode begins)
    4       the world's initial state                     the driver
    5, 6    a step of the world                           Algorithm.act, the driver
    7       it is added to D_E                            Algorithm.observe       ┐ after every step
    11, 12  G updates of every member on mixed data       PsMbpo.learn            ┘
    15      the member that acted is credited             Algorithm.credit        (when an episode ends)

The paper retrains models once an episode and imagines at every step. Here both happen once a period, as in MBPO, from
as many states as all its steps would have started from: episodes may last from one step to a thousand, and models are
then as good for a short one.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.types import Counters, EpisodeEnd, SeedState, TrainState, Transition


def over_seeds(function: Callable, out_axes: Any = 0) -> Callable:
    """`function` of (counters, state of one seed, ...) for every seed of this device; counters are shared."""

    def batched(counters, *args):
        return jax.vmap(lambda *one: function(counters, *one), out_axes=out_axes)(*args)

    return batched


def split_keys(seeds: SeedState, count: int) -> tuple[SeedState, jax.Array]:
    """Takes `count` keys [S, count] from every seed's own."""
    keys = jax.vmap(lambda key: jax.random.split(key, count + 1))(seeds.key)
    return seeds.replace(key=keys[:, 0]), keys[:, 1:]


def begin_stride(algorithm: Algorithm, state: TrainState) -> tuple[TrainState, jax.Array]:
    """Refreshes models and imagined data where a period begins, and says whether this period learns: not before the
    warm-up is over."""
    counters, seeds = state.counters, state.seeds
    into_period = counters.env_steps % algorithm.settings.model_update_every
    learning = counters.env_steps - into_period >= algorithm.settings.warmup_steps
    advanced, keys = split_keys(seeds, 1)
    seeds = seeds.replace(key=jnp.where(into_period == 0, advanced.key, seeds.key))
    seeds = over_seeds(algorithm.begin_epoch)(counters, seeds)
    needed = algorithm.layout.any_seed(over_seeds(algorithm.refreshes)(counters, seeds))
    enabled = (into_period == 0) & learning & needed

    def refresh(counters, state, key):  # lines 2 and 8 to 10
        return algorithm.refresh(counters, state, enabled, key)

    counters, seeds = over_seeds(refresh, out_axes=(None, 0))(counters, seeds, keys[:, 0])
    return state.replace(counters=counters, seeds=seeds), learning


def observe_and_learn(
    algorithm: Algorithm,
    counters: Counters,
    seeds: SeedState,
    transition: Transition,
    truncated: jax.Array,
    keys: jax.Array,
    learning: jax.Array,
) -> tuple[Counters, SeedState, EpisodeEnd]:
    """What follows every real step: lines 7, 15, 1 and 3, then 11 and 12.

    Shapes: transition leaves [S, ...], truncated [S], keys [S, 2].
    """
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
