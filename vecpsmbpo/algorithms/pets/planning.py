"""Planning in the models, as PETS does (Chua et al., 2018): the cross-entropy method over trajectory sampling."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vecpsmbpo import dynamics
from vecpsmbpo.algorithms.pets.settings import PetsSettings
from vecpsmbpo.networks import GaussianMLP
from vecpsmbpo.types import EnvSpec, Model, possible

INITIAL_VARIANCE = 0.25  # of actions in [-1, 1]: (range / 4)²
SMOOTHING = 0.1  # of what the distribution was before an iteration, kept


def cross_entropy(
    value: Callable[[Float[Array, "K H A"], PRNGKeyArray], Float[Array, " K"]],
    mean: Float[Array, "H A"],
    key: PRNGKeyArray,
    settings: PetsSettings,
) -> Float[Array, "H A"]:
    """The plan around which the cross-entropy method ends up.

    Every iteration draws candidates from a normal distribution, truncated at two deviations and narrowed where it
    would leave [-1, 1], and moves it to the mean and variance of the best of them.

    Args:
        value: (plans, key) -> what each is worth.
        mean: where to begin.
    """

    def iterate(carry, key):
        mean, variance = carry
        draw_key, value_key = jax.random.split(key)
        room = jnp.minimum(1 - mean, mean + 1) / 2
        deviation = jnp.sqrt(jnp.minimum(variance, room**2))
        noise = jax.random.truncated_normal(draw_key, -2.0, 2.0, (settings.plan_population, *mean.shape))
        plans = mean + deviation * noise
        worth = value(plans, value_key)
        # Of a plan in which a model diverges nothing is known; `top_k` would put NaN first.
        _, best = jax.lax.top_k(jnp.where(possible(worth), worth, -jnp.inf), settings.plan_elites)
        elites = plans[best]
        mean = SMOOTHING * mean + (1 - SMOOTHING) * jnp.mean(elites, axis=0)
        variance = SMOOTHING * variance + (1 - SMOOTHING) * jnp.var(elites, axis=0)
        return (mean, variance), None

    start = mean, jnp.full(mean.shape, INITIAL_VARIANCE)
    (mean, _), _ = jax.lax.scan(iterate, start, jax.random.split(key, settings.plan_iterations))
    return mean


def expected_returns(
    models: Model,
    obs: Float[Array, " O"],
    plans: Float[Array, "K H A"],
    key: PRNGKeyArray,
    *,
    net: GaussianMLP,
    settings: PetsSettings,
    spec: EnvSpec,
) -> Float[Array, " K"]:
    """What each plan earns in the models, the mean over its particles.

    Every particle starts from `obs`. The particles of a plan are spread evenly over the models; each stays in its own
    (TS∞), or, with `rollout_models=any`, they are shuffled before every step (TS1). A particle that terminates
    earns nothing more.

    Args:
        models: leaves [N, ...].
        plans: each action is held for `plan_hold` steps.
    """
    count, particles, n_models = plans.shape[0], settings.plan_particles, settings.n_models
    predict = partial(dynamics.predict, net=net, spec=spec)

    def step(carry, xs):
        obs, alive, total = carry
        action, key = xs  # action [K, A]
        shuffle_key, model_key = jax.random.split(key)
        if settings.rollout_models == "any":
            order = jnp.argsort(jax.random.uniform(shuffle_key, (count, particles)), axis=-1)
            obs, alive, total = (jax.vmap(lambda x, o: x[o])(x, order) for x in (obs, alive, total))
        # [K, particles, O] -> [N, K · particles / N, O]: a model predicts only its own particles.
        by_model = _by_model(obs, n_models)
        actions = _by_model(jnp.broadcast_to(action[:, None], (count, particles, action.shape[-1])), n_models)
        answer = jax.vmap(predict)(models, by_model, actions, jax.random.split(model_key, n_models))
        next_obs, reward, terminated = (_by_plan(x, count) for x in answer)
        return (next_obs, alive & ~terminated, total + jnp.where(alive, reward, 0.0)), None

    start = (
        jnp.broadcast_to(obs, (count, particles, obs.shape[-1])),
        jnp.ones((count, particles), bool),
        jnp.zeros((count, particles)),
    )
    actions = jnp.repeat(jnp.swapaxes(plans, 0, 1), settings.plan_hold, axis=0)
    (_, _, total), _ = jax.lax.scan(step, start, (actions, jax.random.split(key, actions.shape[0])))
    return jnp.mean(total, axis=-1)


def _by_model(x: jax.Array, n_models: int) -> jax.Array:
    """[K, P, ...] -> [N, K · P / N, ...]: particle p belongs to model p // (P / N)."""
    count, particles = x.shape[:2]
    grouped = x.reshape(count, n_models, particles // n_models, *x.shape[2:])
    return jnp.swapaxes(grouped, 0, 1).reshape(n_models, -1, *x.shape[2:])


def _by_plan(x: jax.Array, count: int) -> jax.Array:
    """The inverse of `_by_model`."""
    grouped = x.reshape(x.shape[0], count, -1, *x.shape[2:])
    return jnp.swapaxes(grouped, 0, 1).reshape(count, -1, *x.shape[2:])
