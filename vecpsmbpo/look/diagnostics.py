"""What a checkpoint's models and critics are worth: measures of one model, one critic, some episodes.

Axes: N models, W windows (a start in a fresh episode and what followed), H steps ahead, O observation, A action, D =
O + 1 what a model predicts (the next observation and the reward), E episodes, T steps, P members.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import norm

from vecpsmbpo import dynamics, networks, sac
from vecpsmbpo.look.fresh import Episodes
from vecpsmbpo.types import EnvSpec, Model, Params

Array = np.ndarray

PARTICLES = 20  # K, draws of a model's future
WINDOWS = 256  # W, where there are as many
ROWS = 4000  # transitions that calibration is measured on
LEVELS = (0.5, 0.9, 0.95)  # of intervals
BINS = 20  # of the histogram of probability integral transforms
QUANTILES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)  # between groups
TAIL = 0.01  # of a state's return may lie beyond what was seen of it


# ── models ────────────────────────────────────────────────────────────────────────────────────────────────────────


class Windows(NamedTuple):
    """Attributes:
    obs: [W, O], where they begin.
    action: [W, H, A] really taken.
    truth: [W, H, D], the observations that followed, and the rewards.
    there: [W, H] bool, whether the episode went on so far.
    """

    obs: Array
    action: Array
    truth: Array
    there: Array

    def until(self, horizon: int) -> "Windows":
        """The first `horizon` steps ahead."""
        return self._replace(
            action=self.action[:, :horizon], truth=self.truth[:, :horizon], there=self.there[:, :horizon]
        )


def windows(episodes: Episodes, horizon: int, length: int, random: np.random.Generator) -> Windows:
    """Starts drawn evenly from the first `length` steps of all episodes."""
    starts = np.argwhere(episodes.there[:, :length])
    chosen = starts[random.permutation(len(starts))[:WINDOWS]]
    steps = episodes.there.shape[1]
    times = chosen[:, 1:] + np.arange(horizon)
    place = chosen[:, :1], np.minimum(times, steps - 1)
    truth = np.concatenate([episodes.next_obs, episodes.reward[..., None]], axis=-1)
    there = episodes.there[place] & (times < steps)
    return Windows(episodes.obs[tuple(chosen.T)], episodes.action[place], truth[place], there)


@partial(jax.jit, static_argnames=("net", "spec"))
def imagine(
    models: Model, obs: jax.Array, action: jax.Array, key: jax.Array, *, net: networks.GaussianMLP, spec: EnvSpec
) -> tuple[jax.Array, jax.Array]:
    """What each model expects to follow from obs [W, O] under the actions [W, H, A]: mean and variance [N, W, H, D].

    Both are of K draws of the future, each step from the state drawn before it (equation 21); the variance is unbiased.
    Ends of episodes are not imagined.
    """

    def of_model(xs):
        model, key = xs

        def step(states, xs):
            action, key = xs
            taken = jnp.broadcast_to(action, (PARTICLES, *action.shape))
            answer = dynamics.predict(model, states, taken, key, net=net, spec=spec)
            drawn = jnp.concatenate([answer.next_obs, answer.reward[..., None]], axis=-1)
            return answer.next_obs, (drawn.mean(axis=0), drawn.var(axis=0, ddof=1))

        start = jnp.broadcast_to(obs, (PARTICLES, *obs.shape))
        _, said = jax.lax.scan(step, start, (action.swapaxes(0, 1), jax.random.split(key, action.shape[1])))
        return jax.tree.map(lambda x: x.swapaxes(0, 1), said)

    count = models.loss.shape[0]
    return jax.lax.map(of_model, (models, jax.random.split(key, count)))


class Errors(NamedTuple):
    """Root mean squares over windows.

    Attributes:
        error: [N, H, D], of the truth less the model's mean.
        expected: [N, H, D], of the model's own standard deviation: equal to `error` for a model that is right.
        no_change: [H, D], of the truth less where the window began, and less the mean reward: what knows nothing.
        disagreement: [H, D], of the standard deviation between the models' means; NaN for one model.
    """

    error: Array
    expected: Array
    no_change: Array
    disagreement: Array


def errors(mean: Array, variance: Array, seen: Windows) -> Errors:
    """Of what models said, [N, W, H, D] each.

    A mean of K draws is off by their variance / K on average, which is taken off again.
    """
    # A model that runs away exceeds any number: infinity says so.
    with np.errstate(over="ignore", invalid="ignore"):
        mean, noise = mean.astype(float), variance.astype(float) / PARTICLES
        squares = (mean - seen.truth) ** 2 - noise
        steady = np.full(seen.truth.shape, seen.truth[seen.there][:, -1].mean())
        steady[..., :-1] = seen.obs[:, None]
        between = mean.var(axis=0, ddof=1) - noise.mean(axis=0) if len(mean) > 1 else np.full(mean.shape[1:], np.nan)
        root = lambda values: np.sqrt(np.maximum(_mean(values, seen.there), 0.0))  # noqa: E731
        return Errors(root(squares), root(variance.astype(float)), root((seen.truth - steady) ** 2), root(between))


def relative(values: Array, std: Array) -> Array:
    """Root mean square over the observation's coordinates, each in units of its deviation `std` [D]: values
    [..., D] -> [...]. Coordinates that do not vary do not count, nor does the reward."""
    varies = std[:-1] > 0
    with np.errstate(over="ignore", invalid="ignore"):
        return np.sqrt(np.mean((values[..., :-1][..., varies] / std[:-1][varies]) ** 2, axis=-1))


def _mean(values: Array, there: Array) -> Array:
    """Over the windows [..., W, H, D] that are `there` [W, H]: [..., H, D]; NaN where none is."""
    count = there.sum(axis=0)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(there[..., None], values, 0.0).sum(axis=-3) / count


class OneStep(NamedTuple):
    """Attributes:
    error: [N, B, D], what happened less the mean that a model predicted for it.
    expected: [N, B, D], the deviation that it predicted.
    """

    error: Any
    expected: Any


@partial(jax.jit, static_argnames="net")
def one_step(
    models: Model, obs: jax.Array, action: jax.Array, truth: jax.Array, *, net: networks.GaussianMLP
) -> OneStep:
    """What each model says of the next observations and rewards truth [B, D] (equation 20)."""
    start = jnp.concatenate([obs, jnp.zeros_like(obs[:, :1])], axis=-1)

    def of_model(model):
        said = dynamics.forward(model, obs, action, net=net)
        return OneStep(truth - start - said.mean, jnp.exp(0.5 * said.log_variance))

    return jax.lax.map(of_model, models)


class Calibration(NamedTuple):
    """Attributes:
    coverage: [N, L, D], share of what happened within the model's central interval of each of L `LEVELS`.
    histogram: [N, BINS], densities of the probability integral transform over [0, 1], of all dimensions: 1 everywhere
        for a model that is right, high at the ends for one that is too sure, high in the middle for one that is not.
    """

    coverage: Array
    histogram: Array


def calibration(ahead: OneStep) -> Calibration:
    """Error / expected is standard normal for a model that is right."""
    residuals = ahead.error / ahead.expected
    bounds = norm.ppf(0.5 + np.array(LEVELS) / 2)
    coverage = (np.abs(residuals)[:, None] <= bounds[:, None, None]).mean(axis=2)
    places: Any = norm.cdf(residuals).reshape(len(residuals), -1)
    counts = [np.histogram(one, bins=BINS, range=(0, 1))[0] for one in places]
    return Calibration(coverage, np.stack(counts) * BINS / places.shape[1])


class Reliability(NamedTuple):
    """Root mean squares over the predictions whose expected errors are alike, from the smallest to the largest.

    Attributes:
        expected: [N, Q], of the deviations that the model predicted for them.
        made: [N, Q], of its errors: the same for a model that is right.
    """

    expected: Array
    made: Array


def reliability(ahead: OneStep, std: Array) -> Reliability:
    """Of all dimensions that vary, each in units of its deviation `std` [D]; Q groups, between `QUANTILES`.

    What calibration does not show: intervals hold as much as they should while a few predictions, which rollouts meet
    sooner or later, are given up.
    """
    varies = std > 0
    error, expected = ((x[..., varies].astype(float) / std[varies]).reshape(len(x), -1) for x in ahead)
    order = np.argsort(expected, axis=1)
    edges = np.round(np.array(QUANTILES) * order.shape[1]).astype(int)

    def of_groups(values: Array) -> Array:
        groups = np.split(np.take_along_axis(values, order, axis=1) ** 2, edges, axis=1)
        return np.sqrt(np.stack([group.mean(axis=1) for group in groups if group.size], axis=1))

    return Reliability(of_groups(expected), of_groups(error))


# ── critics ───────────────────────────────────────────────────────────────────────────────────────────────────────


def tail(discount: float, most: int = 3000) -> int:
    """Steps after which no more than `TAIL` of a return is left; `most` where that is further off."""
    return min(most, int(np.ceil(np.log(TAIL) / np.log(discount)))) if 0 < discount < 1 else most * (discount > 0)


def returns(episodes: Episodes, discount: float, alpha: Array) -> Array:
    """What was really earned from every state and action on, as SAC's critics count it (equations 23, 24 and 29):

        G_t = r_t + γ (1 - terminated_t) (G_{t+1} - α log π(a_{t+1} | s_{t+1})),  [E, T].

    Args:
        alpha: [E], of each episode's member; 0 gives the plain discounted return.
    """
    following = np.zeros(len(episodes.reward))
    found = np.zeros_like(episodes.reward, float)
    for t in reversed(range(episodes.reward.shape[1])):
        found[:, t] = episodes.reward[:, t] + discount * ~episodes.terminated[:, t] * following
        following = (found[:, t] - alpha * episodes.log_prob[:, t]) * episodes.there[:, t]
    return found


def known(episodes: Episodes, discount: float) -> Array:
    """[E, T] bool: where enough of what followed was seen to know the return, all of it or all but `TAIL`."""
    left = episodes.there[:, ::-1].cumsum(axis=1)[:, ::-1]
    whole = episodes.terminated.any(axis=1, keepdims=True)
    return episodes.there & (whole | (discount**left <= TAIL))


@partial(jax.jit, static_argnames="actor")
def sample(actors: Params, obs: jax.Array, key: jax.Array, *, actor: networks.Actor) -> tuple[jax.Array, jax.Array]:
    """Actions that each member draws, and their log-densities: actors [P, ...], obs [P, B, O] -> [P, B, A], [P, B]."""
    keys = jax.random.split(key, len(obs))
    return jax.vmap(lambda params, obs, key: actor.distribution(params, obs).sample(key))(actors, obs, keys)


@partial(jax.jit, static_argnames="nets")
def values(critics: Params, obs: jax.Array, action: jax.Array, *, nets: sac.Networks) -> jax.Array:
    """min(Q_1, Q_2) of each member: critics [P, ...], obs [P, B, O], action [P, B, A] -> [P, B]."""
    return jax.vmap(lambda params, obs, action: jnp.minimum(*nets.critic.values(params, obs, action)))(
        critics, obs, action
    )


# ── states ────────────────────────────────────────────────────────────────────────────────────────────────────────


class Nearness(NamedTuple):
    """Median distance to the nearest of the states known, in deviations of theirs: of states imagined, and of real ones
    that were not learned from either."""

    imagined: float
    fresh: float


def nearness(known: Array, imagined: Array, fresh: Array) -> Nearness:
    """Of states [.., O] each."""
    std = known.std(axis=0)
    unit = np.where(std > 0, std, 1.0)
    tree = cKDTree(known / unit)
    return Nearness(*(float(np.median(tree.query(states / unit)[0])) for states in (imagined, fresh)))


def finite(value: Any) -> Any:
    """Arrays as lists of JSON's numbers, to five digits: NaN and infinity are None."""
    if isinstance(value, dict):
        return {name: finite(item) for name, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [finite(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.5g}") if np.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
