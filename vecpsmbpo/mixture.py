"""λ, the share of real data in what policies learn from: constant, falling, or chosen by a bandit (B.3)."""

import jax
import jax.numpy as jnp

from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Bandit, Hyper


def real_ratios(settings: Settings, hyper: Hyper, env_steps: jax.Array) -> jax.Array:
    """[M] the λ with which policies m = 0, 1, ... of every model learn now."""
    if settings.adapts_real_ratio:
        return jnp.asarray(settings.real_ratio_arms)[arm_of(settings, jnp.arange(settings.n_policies))]
    ratio = hyper.real_ratio
    if settings.real_ratio_schedule == "linear":
        # Of the steps that learn, so that as many real rows are used as with the constant.
        learning = max(settings.total_steps - settings.first_learning_step, 1)
        ratio = linear(ratio, jnp.maximum(env_steps - settings.first_learning_step, 0) / learning)
    return jnp.broadcast_to(ratio, (settings.n_policies,))


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


# ── the bandit: discounted Thompson sampling (Raj and Kalyani, 2017; regret: Qi, Guo and Zhu, 2025) ──────────────
#
# An arm is a value of λ, and policy m of every model learns with arm m mod K throughout: what one arm does to a critic
# is its own, all arms learn from the same real data D_E, and where there are M >= K policies anyhow this costs nothing.
# A round is an episode: an arm is drawn, and the member that acts among those of the arm by equation 18 or 19. It gains
# the episode's return. (The other way, all policies changing λ together every epoch, was tried: one epoch of a bad λ
# spoils all critics, and the blame falls on the arm after it; docs/results.md.)
#
# What an arm is worth changes while it learns, so that a rule which competes with the best single arm in hindsight
# (explore-then-commit, UCB, Exp3) competes with the wrong thing. Exp3.S and its kin follow changes whatever causes
# them, but are made for an opponent who knows the algorithm, and need hundreds of rounds where runs have tens to
# hundreds of episodes. Thompson sampling is the paper's own principle one level up. Discounting forgets what policies
# earned when they knew less; with it, regret against the best arm of every moment is within logarithms of optimal for
# arms that jump, and sublinear for arms that drift.

GRID = 512


def arm_of(settings: Settings, member: jax.Array) -> jax.Array:
    """The arm of member n·M + m."""
    return member % settings.n_policies % len(settings.real_ratio_arms)


def init(settings: Settings) -> Bandit:
    """Nothing is known: arms are equally likely."""
    nothing, most = jnp.zeros(len(settings.real_ratio_arms)), jnp.float32(1e30)
    return Bandit(returns=nothing, counts=nothing, rounds=jnp.int32(0), lowest=most, highest=-most)


def discount(rounds: jax.Array) -> jax.Array:
    """What of earlier rounds is left after one more: 1 - 1 / (8 √rounds).

    The order is that of the optimum for few changes (Garivier and Moulines, 2011, who take 1 / 4); rounds so far stand
    for their total, which nobody knows before episodes end. Arms that drift as policies do are followed better with
    twice that memory.
    """
    return 1 - 1 / (8 * jnp.sqrt(jnp.maximum(rounds, 1)))


def credit(bandit: Bandit, arm: jax.Array, episode_return: jax.Array, done: jax.Array, counts: jax.Array) -> Bandit:
    """Adds the return of an episode that is `done` to its arm where it `counts`. Random episodes set the scale only."""
    rounds = bandit.rounds + counts
    kept = jnp.where(counts, discount(rounds), 1.0)
    one = counts * jax.nn.one_hot(arm, bandit.counts.shape[0])
    return Bandit(
        returns=kept * bandit.returns + one * episode_return,
        counts=kept * bandit.counts + one,
        rounds=rounds,
        lowest=jnp.where(done, jnp.minimum(bandit.lowest, episode_return), bandit.lowest),
        highest=jnp.where(done, jnp.maximum(bandit.highest, episode_return), bandit.highest),
    )


def beliefs(bandit: Bandit) -> tuple[jax.Array, jax.Array]:
    """[K] each: the parameters of the Beta distribution of what each arm gains, uniform at first.

    A gain is where the return lies in the range of all returns so far, from 0 to 1; a gain of 0.3 is 0.3 successes and
    0.7 failures. While all returns are equal, as before the first success of a sparse task, all gains are 0: arms that
    were tried less are tried next.
    """
    span = jnp.maximum(bandit.highest - bandit.lowest, 1e-6)
    gains = jnp.clip((bandit.returns - bandit.counts * bandit.lowest) / span, 0.0, bandit.counts)
    return 1 + gains, 1 + bandit.counts - gains


def probabilities(bandit: Bandit) -> jax.Array:
    """[K] how likely each arm is the best, ∫ p_i(x) Π_{j ≠ i} P(x_j < x) dx: the distribution that Thompson sampling
    draws from, by the midpoint rule.

    It could be drawn from without being known, but who acts is drawn once, from a distribution that is logged.
    """
    wins, losses = beliefs(bandit)
    x = (jnp.arange(GRID) + 0.5) / GRID
    mass = jax.nn.softmax((wins - 1)[:, None] * jnp.log(x) + (losses - 1)[:, None] * jnp.log1p(-x), axis=1)
    below = jnp.cumsum(mass, axis=1) - mass / 2
    itself = jnp.eye(mass.shape[0], dtype=bool)[:, :, None]
    best = jnp.sum(mass * jnp.prod(jnp.where(itself, 1.0, below), axis=1), axis=1)
    return best / jnp.sum(best)


def by_arm(bandit: Bandit, settings: Settings, logits: jax.Array) -> jax.Array:
    """[N·M] logits of drawing an arm and then, by the `logits` given, one of its members."""
    arm = arm_of(settings, jnp.arange(settings.n_members))
    arms = jnp.arange(bandit.counts.shape[0])
    of_arm = jax.nn.logsumexp(jnp.where(arms[:, None] == arm, logits, -jnp.inf), axis=1)
    return logits - of_arm[arm] + jnp.log(probabilities(bandit))[arm]
