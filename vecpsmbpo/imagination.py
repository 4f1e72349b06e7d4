"""Rolls policies out in models: the rows of D_M^{n,m} (Algorithm 1, lines 9 and 10), and how many there are."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vecpsmbpo import dynamics, networks, replay, sac
from vecpsmbpo.settings.parts import ImaginationSettings
from vecpsmbpo.types import EnvSpec, Model, Params, Transition, Whole

LARGEST_BATCH = 4096  # rows of one member in flight: enough to fill the machine, small enough to stay in cache


def batch_size(settings: ImaginationSettings) -> int:
    """Start states rolled out together: an even part of `rollout_starts`, and at most as many as the ring can hold the
    longest rollouts of."""
    starts = settings.rollout_starts
    most = max(min(LARGEST_BATCH, settings.imagined_capacity // longest_horizon(settings)), 1)
    fewest = -(-starts // most)
    # Parts that leave no rest, if there are some nearly as large; else a few starts less.
    parts = next((count for count in range(fewest, 2 * fewest + 1) if starts % count == 0), fewest)
    return starts // parts


def longest_horizon(settings: ImaginationSettings) -> int:
    """Steps of a rollout, at most, in the whole run."""
    return max(settings.horizon_first, settings.horizon_last)


def ring_capacity(settings: ImaginationSettings) -> int:
    """C_M: what one epoch can imagine for a member at the longest horizon, up to `imagined_capacity`.

    A multiple of the batch, so that a block of rows never wraps. At a shorter horizon it would hold many epochs: see
    `retained_rows`.
    """
    wanted = settings.rollout_starts * longest_horizon(settings) * settings.refreshes_per_epoch
    batch = batch_size(settings)
    return max(min(wanted, settings.imagined_capacity) // batch, 1) * batch


def horizon(settings: ImaginationSettings, env_steps: Int[Array, "*steps"] | int) -> Int[Array, "*steps"]:
    """Table 1's schedule x → y over epochs a → b: ⌊clip(x + (k - a) / (b - a) · (y - x))⌋.

    k counts whole epochs of 1000 environment steps, whatever `epoch_steps` is.
    """
    first, last = settings.horizon_first, settings.horizon_last
    start, end = settings.horizon_ramp_start, settings.horizon_ramp_end
    # The small addend keeps an exact corner, such as k = b, from being floored away by float32 rounding.
    value = first + (env_steps // 1000 - start) / (end - start) * (last - first) + 1e-4
    return jnp.floor(jnp.clip(value, min(first, last), max(first, last))).astype(jnp.int32)


def batches_per_refresh(settings: ImaginationSettings, horizon: Int[Array, "*steps"] | int) -> Int[Array, "*steps"]:
    """How many batches of start states one refresh rolls out.

    When starts × horizon would exceed the ring, there are fewer starts; a rollout is never cut short.
    """
    batch = batch_size(settings)
    return jnp.clip(ring_capacity(settings) // (horizon * batch), 1, settings.rollout_starts // batch)


def rows_per_refresh(settings: ImaginationSettings, env_steps: Int[Array, "*steps"] | int) -> Int[Array, "*steps"]:
    """How many transitions one refresh imagines for each member."""
    now = horizon(settings, env_steps)
    return batches_per_refresh(settings, now) * now * batch_size(settings)


def retained_rows(settings: ImaginationSettings, env_steps: Whole) -> Int[Array, ""]:
    """How many of the newest rows policies learn from after `env_steps` steps: those of one epoch of refreshes.

    As both MBPO codebases have it: older rows come from models fitted on less data and from policies of long ago. Each
    refresh counts at the horizon it had. (Where there have been fewer, `added` of `replay.sample_newest_indices` bounds
    the rows.)
    """
    period = settings.model_update_every
    # The step that ends a period learns before the next refresh.
    last = (env_steps - 1) // period * period
    refreshes = last - period * jnp.arange(settings.refreshes_per_epoch)
    return jnp.minimum(jnp.sum(rows_per_refresh(settings, refreshes)), ring_capacity(settings))


def step(
    model: Model,
    actor: Params,
    obs: Float[Array, "B O"],
    key: PRNGKeyArray,
    *,
    net: networks.GaussianMLP,
    nets: sac.Networks,
    settings: ImaginationSettings,
    spec: EnvSpec,
) -> Transition:
    """One imagined step of one member for a batch of states.

    Args:
        model: the member's own, or with `rollout_models=any` all of them, [N, ...].

    Returns:
        Transition with leaves [B, ...]; the policy's sampled action, the model's sampled successor, reward and end.
    """
    action_key, model_key = jax.random.split(key)
    action, _ = nets.actor.distribution(actor, obs).sample(action_key)
    predict = partial(dynamics.predict, net=net, spec=spec)
    if settings.rollout_models == "any":
        predict = partial(predict_with_any, predict)
    next_obs, reward, terminated = predict(model, obs, action, model_key)
    return Transition(obs, action, reward, next_obs, terminated)


def predict_with_any(
    predict: Callable[..., dynamics.Successor],
    models: Model,
    obs: Float[Array, "B O"],
    action: Float[Array, "B A"],
    key: PRNGKeyArray,
) -> dynamics.Successor:
    """For every row a model drawn anew, as in MBPO and in TS1 of PETS.

    Rows are shuffled and cut into N parts: each row's model is drawn whatever it was a step before, uniformly as far as
    N divides B (else the last part is a few rows smaller), and a row costs one model and not N.

    Args:
        predict: of one model.
        models: leaves [N, ...].
    """
    key, shuffle_key = jax.random.split(key)
    count, rows = models.loss.shape[0], obs.shape[0]
    part = -(-rows // count)
    # The last part is filled up with rows that are predicted twice; the first prediction counts.
    order = jnp.resize(jax.random.permutation(shuffle_key, rows), (count, part))
    place = jnp.argsort(order.reshape(-1)[:rows])
    answers = jax.vmap(predict)(models, obs[order], action[order], jax.random.split(key, count))
    return jax.tree.map(lambda x: x.reshape(count * part, *x.shape[2:])[place], answers)


def start_states(
    real: Float[Array, "C F"], added: Whole, key: PRNGKeyArray, count: int, spec: EnvSpec
) -> Float[Array, "{count} O"]:
    """Observations drawn uniformly from D_E."""
    return real[replay.sample_indices(key, (count,), added, real.shape[0]), : spec.obs_size]
