"""λ, the share of real data in what policies learn from: constant, falling, or chosen by a bandit (B.3)."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from vecpsmbpo.settings.parts import PosteriorSettings
from vecpsmbpo.types import Hyper, Number, Whole


class Bandit(struct.PyTreeNode):
    """What is known of the K values of λ to choose from.

    Attributes:
        excess, counts: [K], sum of returns above `lowest`, and number, of each arm's episodes, older ones discounted.
        rounds: [] int, episodes so far.
        lowest, highest: [], the range of returns, in which old ones are forgotten; ±1e30 before the first.
    """

    excess: jax.Array
    counts: jax.Array
    rounds: jax.Array
    lowest: jax.Array
    highest: jax.Array


def real_ratios(
    settings: PosteriorSettings, hyper: Hyper, bandit: Bandit | None, env_steps: Whole
) -> Float[Array, " members"]:
    """The λ with which each member learns now."""
    if bandit is not None:
        return jnp.asarray(settings.real_ratio_arms)[arms_of_members(settings, bandit)]
    ratio = hyper.real_ratio
    if settings.real_ratio_schedule == "linear":
        # Of the steps that learn, so that as many real rows are used as with the constant.
        learning = max(settings.total_steps - settings.first_learning_step, 1)
        ratio = linear(ratio, jnp.maximum(env_steps - settings.first_learning_step, 0) / learning)
    return jnp.broadcast_to(ratio, (settings.n_members,))


def linear(mean: Number, progress: Float[Array, "*steps"] | float) -> Float[Array, "*steps"]:
    """λ after a share `progress` of the learning, on a line from 1 to 0 under which lies the same area as under the
    constant `mean` (figure 13).

    Up to a mean of 1/2 the line begins at once, reaches 0 at 2 · mean, and stays there; for a larger mean it begins so
    much later that it reaches 0 at the end.
    """
    length = 2 * jnp.minimum(mean, 1 - mean)
    start = jnp.maximum(2 * mean - 1, 0.0)
    # A mean of 0 or 1 leaves no line: a step, at the start or at the end.
    return jnp.clip(1 - (progress - start) / jnp.maximum(length, 1e-6), 0.0, 1.0)


# ── the bandit: discounted Thompson sampling (Raj and Kalyani, 2017) ─────────────────────────────────────────────
#
# An arm is a value of λ, a round is an episode, and the arm of the member that acts gains the episode's return. From
# what is known of the arms follows how likely each is the best; Thompson sampling draws arms with that probability, and
# here every member is such a draw: of N·M members, a share p_i learns with arm i, and whichever of them equation 18 or
# 19 lets act plays its arm. At first all arms learn side by side, each with critics of its own, from the same real
# data D_E; when one shows to be better, more and more members learn with it. Two other ways were tried
# (docs/lab_notes.md): λ changed every epoch for all members together spoils all critics in an epoch of a bad λ and
# blames the arm after it; and with an arm for each member for good, the best one learns from data of which the others
# gather most.
#
# What an arm is worth changes while it learns, so that a rule which competes with the best single arm in hindsight
# (explore-then-commit, UCB, Exp3) competes with the wrong thing. Exp3.S and its kin follow changes whatever causes
# them, but are made for an opponent who knows the algorithm, and need hundreds of rounds where runs have tens to
# hundreds of episodes. Thompson sampling is the paper's own principle one level up, and discounting forgets what
# members earned when they knew less. Where arms change a few times and not because of the choices, its regret against
# the best arm of every moment is within logarithms of optimal (Qi, Guo and Zhu, 2025, for Gaussian beliefs and a tuned
# discount). Here arms learn from what the others see; no rule has a guarantee for that.

GRID = 512


def arms_of_members(settings: PosteriorSettings, bandit: Bandit) -> Int[Array, " members"]:
    """The arm of each member: the arms' probabilities cut into N·M equal pieces, in the order of λ.

    So a member's λ moves from one arm to the next or stays; m decides before n, so that every model has members of high
    and of low λ. An arm less likely than half a piece rests until forgetting makes it likelier again.
    """
    member = jnp.arange(settings.n_members)
    models = settings.n_members // settings.n_policies
    rank = member % settings.n_policies * models + member // settings.n_policies
    arm = jnp.searchsorted(jnp.cumsum(probabilities(bandit)), (rank + 0.5) / settings.n_members)
    return jnp.minimum(arm, bandit.counts.shape[0] - 1)


def init(settings: PosteriorSettings) -> Bandit:
    """Nothing is known: arms are equally likely."""
    nothing, most = jnp.zeros(len(settings.real_ratio_arms)), jnp.float32(1e30)
    return Bandit(excess=nothing, counts=nothing, rounds=jnp.int32(0), lowest=most, highest=-most)


def discount_of_rounds(rounds: Whole) -> Float[Array, ""]:
    """What of earlier rounds is left after one more: 1 - 1 / (8 √rounds).

    The order is that of the optimum for few changes (Garivier and Moulines, 2011, who take 1 / 4); rounds so far stand
    for their total, which nobody knows before episodes end. Arms that drift as policies do are followed better with
    twice that memory.
    """
    return 1 - 1 / (8 * jnp.sqrt(rounds))


def credit(bandit: Bandit, arm: Whole, episode_return: Number) -> Bandit:
    """Adds an episode's return to its arm.

    The range shrinks around its middle as old rounds are forgotten, and always holds the newest return: an outlier or
    the returns of the first policies do not make all later ones look alike. Sums are of what lies above the lower end,
    since sums of the returns themselves, thousands each, would leave nothing but rounding where all are equal.
    """
    rounds = bandit.rounds + 1
    kept = discount_of_rounds(rounds)
    middle, half = (bandit.highest + bandit.lowest) / 2, (bandit.highest - bandit.lowest) / 2 * kept
    lowest, highest = jnp.minimum(middle - half, episode_return), jnp.maximum(middle + half, episode_return)
    excess = bandit.excess + bandit.counts * (bandit.lowest - lowest)
    one = jax.nn.one_hot(arm, bandit.counts.shape[0])
    return Bandit(
        excess=kept * excess + one * (episode_return - lowest),
        counts=kept * bandit.counts + one,
        rounds=rounds,
        lowest=lowest,
        highest=highest,
    )


def beliefs(bandit: Bandit) -> tuple[Float[Array, " K"], Float[Array, " K"]]:
    """The parameters of the Beta distribution of what each arm gains, uniform at first.

    A gain is where the return lies in the range of returns, from 0 to 1; a gain of 0.3 is 0.3 successes and 0.7
    failures. While all returns are equal, as before the first success of a sparse task, all gains are 0: arms that were
    tried less are tried next.
    """
    gains = jnp.clip(bandit.excess / jnp.maximum(bandit.highest - bandit.lowest, 1e-6), 0.0, bandit.counts)
    return 1 + gains, 1 + bandit.counts - gains


def probabilities(bandit: Bandit) -> Float[Array, " K"]:
    """How likely each arm is the best, ∫ p_i(x) Π_{j ≠ i} P(x_j < x) dx: the distribution that Thompson sampling
    draws from. By the midpoint rule over θ, x = sin² θ, where Beta distributions are about as wide everywhere."""
    wins, losses = beliefs(bandit)
    angle = jnp.pi / 2 * (jnp.arange(GRID) + 0.5) / GRID
    log_sin, log_cos = jnp.log(jnp.sin(angle)), jnp.log(jnp.cos(angle))
    mass = jax.nn.softmax((2 * wins - 1)[:, None] * log_sin + (2 * losses - 1)[:, None] * log_cos, axis=1)
    below = jnp.cumsum(mass, axis=1) - mass / 2
    itself = jnp.eye(mass.shape[0], dtype=bool)[:, :, None]
    best = jnp.sum(mass * jnp.prod(jnp.where(itself, 1.0, below), axis=1), axis=1)
    return best / jnp.sum(best)
