"""λ, the share of real data in what policies learn from: constant, falling, or chosen by a bandit (B.3)."""

import math

import jax
import jax.numpy as jnp

from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Bandit, Hyper


def real_ratio(settings: Settings, hyper: Hyper, bandit: Bandit | None, env_steps: jax.Array) -> jax.Array:
    """λ now, []."""
    if settings.real_ratio_schedule == "linear":
        # Of the steps that learn, so that as many real rows are used as with the constant.
        learning = max(settings.total_steps - settings.first_learning_step, 1)
        return linear(hyper.real_ratio, jnp.maximum(env_steps - settings.first_learning_step, 0) / learning)
    if bandit is not None:
        return jnp.asarray(settings.real_ratio_arms)[bandit.arm]
    return hyper.real_ratio


def linear(mean: jax.Array, progress: jax.Array) -> jax.Array:
    """λ after a share `progress` of the learning, on a line from 1 to 0 under which lies the same area as under the
    constant `mean` (figure 13).

    Up to a mean of 1/2 the line begins at once, reaches 0 at 2 · mean, and stays there; for a larger mean it begins so
    much later that it reaches 0 at the end.
    """
    length = 2 * jnp.minimum(mean, 1 - mean)
    start = jnp.maximum(2 * mean - 1, 0.0)
    # A mean of 0 or 1 leaves no line: a step, at the start or at the end.
    return jnp.clip(1 - (progress - start) / jnp.maximum(length, 1e-6), 0.0, 1.0)


# ── the bandit: Exp3.S (Auer, Cesa-Bianchi, Freund and Schapire, 2002, section 8) ────────────────────────────────
#
# An arm is a value of λ, a round is an epoch, and what an arm gains is how much the return improved while it was in
# force. What the best λ is changes while models and policies learn, so that a rule which competes with the best single
# arm in hindsight (explore-then-commit, UCB, Exp3) competes with the wrong thing; and gains depend on everything that
# was done before, so that nothing may be assumed of their distribution. Exp3.S needs no such assumption and has no
# regret against the best sequence of arms with few changes: no weight ever falls so low that its arm could not return.


HARDNESS = 2  # 1 + the number of changes of the best arm that are reckoned with
MOST_EXPLORED = 0.5


def init(settings: Settings, key: jax.Array) -> Bandit:
    """Equal weights, and a first arm."""
    count = len(settings.real_ratio_arms)
    nothing = jnp.zeros(())
    return Bandit(jnp.zeros(count), jax.random.randint(key, (), 0, count), jnp.int32(0), nothing, nothing, nothing)


def rates(settings: Settings) -> tuple[float, float]:
    """γ, how much is explored, and α, how much weight is shared: those that bound the regret against the best sequence
    with one change of arms (hardness S = 2).

    Below some hundred rounds that γ nears 1, at which no gain would count (and the bound promises nothing). So short
    runs explore half of the time.
    """
    arms, learning = len(settings.real_ratio_arms), settings.total_steps - settings.first_learning_step
    rounds = max(learning // settings.epoch_steps, 1)
    explored = math.sqrt(arms * (HARDNESS * math.log(arms * rounds) + math.e) / ((math.e - 1) * rounds))
    return min(MOST_EXPLORED, explored), 1 / rounds


def probabilities(bandit: Bandit, settings: Settings) -> jax.Array:
    """[K] the distribution that the next arm is drawn from."""
    explored, _ = rates(settings)
    return (1 - explored) * jax.nn.softmax(bandit.log_weights) + explored / bandit.log_weights.shape[0]


def end_round(bandit: Bandit, settings: Settings, episode_return: jax.Array, key: jax.Array) -> Bandit:
    """Rewards the arm in force with the epoch's mean return, and draws the next one.

    The gain lies in [0, 1]: 1/2 plus half the change since the epoch before, in units of the range of all epochs' mean
    returns so far. The first epoch has nothing to be compared with, and the second no scale: its change is the range.
    """
    first = bandit.rounds == 0
    lowest = jnp.where(first, episode_return, jnp.minimum(bandit.lowest, episode_return))
    highest = jnp.where(first, episode_return, jnp.maximum(bandit.highest, episode_return))
    change = (episode_return - bandit.previous) / jnp.maximum(highest - lowest, 1e-6)
    weights = reinforce(bandit, settings, 0.5 + 0.5 * jnp.clip(change, -1.0, 1.0))
    bandit = bandit.replace(
        log_weights=jnp.where(bandit.rounds >= 2, weights, bandit.log_weights),
        rounds=bandit.rounds + 1,
        previous=episode_return,
        lowest=lowest,
        highest=highest,
    )
    return bandit.replace(arm=jax.random.categorical(key, jnp.log(probabilities(bandit, settings))))


def reinforce(bandit: Bandit, settings: Settings, gain: jax.Array) -> jax.Array:
    """[K] the logarithms of w_i exp(γ x̂_i / K) + (e α / K) Σ w, where x̂ is the gain of the arm over its probability.

    The largest is 0: only their ratios matter.
    """
    explored, shared = rates(settings)
    weights, count = bandit.log_weights, bandit.log_weights.shape[0]
    estimate = gain / probabilities(bandit, settings)[bandit.arm]
    grown = weights.at[bandit.arm].add(explored * estimate / count)
    share = jax.nn.logsumexp(weights) + 1 + math.log(shared / count)
    mixed = jnp.logaddexp(grown, share)
    return mixed - jnp.max(mixed)
