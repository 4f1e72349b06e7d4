"""Example 1, Proposition 1 and Proposition 2: policies and models are few, so every quantity is exact.

The paper's Example 1 contradicts itself: its text gives p(M_1|D) = 1/3 and p(M_2|D) = 2/3, equation 10 the reverse.
Equations 11 and 12 follow from equation 10 alone: with the text's numbers KL(q^δ | p) is log 3/2, not log 3, and not
the largest there is. Both readings are computed.
"""

from typing import NamedTuple

import numpy as np
from scipy.special import rel_entr

Array = np.ndarray

EQUATION_10 = np.array([2 / 3, 1 / 3])  # p(M|D) as in equation 10
TEXT = np.array([1 / 3, 2 / 3])  # p(M|D) as in the sentence before it
WRONG_MODELS = np.array([0.0, 1.0])  # q(M|D) of Example 1
OPTIMAL = np.eye(2)  # δ(π|M): π_1 is optimal for M_1, π_2 for M_2


class LambdaCase(NamedTuple):
    """Example 1 with a q(π|D), which the paper leaves open.

    Attributes:
        name: what q(π|D) is.
        models: q(M|D), [M].
        data: q(π|D) of equation 15, [Π].
    """

    name: str
    models: Array
    data: Array


LAMBDA_CASES = (
    LambdaCase("wrong q(M|D); q(π|D) = p(π|D)", WRONG_MODELS, EQUATION_10),
    LambdaCase("wrong q(M|D); q(π|D) uniform", WRONG_MODELS, np.array([0.5, 0.5])),
    LambdaCase("wrong q(M|D); q(π|D) errs the other way", WRONG_MODELS, np.array([1.0, 0.0])),
    LambdaCase("exact q(M|D); q(π|D) wrong", EQUATION_10, np.array([1.0, 0.0])),
)


def kl(q: Array, p: Array) -> Array:
    """d_KL(q | p) = Σ q log(q / p) over the last axis, in nats; infinite where q has mass and p none."""
    return rel_entr(q, p).sum(axis=-1)


def marginal(conditional: Array, models: Array) -> Array:
    """q(π|D) [Π] from q(π|M) [Π, M] and q(M|D) [M]: equations 5, 8, 10 and 11."""
    return conditional @ models


def largest_kl(p: Array) -> float:
    """max over q of d_KL(q | p), equation 12's right side: all mass on the policy that p holds least likely."""
    return float(-np.log(p.min()))


def best_conditional(optimal: Array, models: Array, p: Array) -> Array:
    """A q(π|M) that minimises d_KL(q(π|D) | p(π|D)), Proposition 1.

    The minimum is 0 whatever q(M|D) is: q(π|M) = p(π|D) for every M attains it. Of all minimisers this one departs
    least from δ(π|M): it moves the probability by which q^δ exceeds p to the policies where q^δ falls short, a total of
    TV(q^δ, p). Models of probability 0 keep their δ, where equation 11 has 1/2: either does.

    Args:
        optimal: δ(π|M), [Π, M], one 1 a column.
        models: q(M|D), [M].
        p: p(π|D), [Π].

    Returns:
        q(π|M), [Π, M].
    """
    degenerate = marginal(optimal, models)
    kept = np.divide(p, degenerate, out=np.ones_like(p), where=degenerate > p)  # of each policy's probability
    stay = kept @ optimal
    lacking = np.maximum(p - degenerate, 0.0)
    refill = lacking / max(lacking.sum(), np.finfo(float).tiny)  # where nothing lacks, nothing has to be moved
    return optimal * stay + np.outer(refill, 1 - stay)


def lambda_curve(optimal: Array, models: Array, data: Array, p: Array, real_ratios: Array) -> Array:
    """d_KL(q(π|D, λ) | p(π|D)), equation 16's left side, for every λ, [L].

    The paper fixes q(π|M, D, λ) at λ = 0 and λ = 1 only (equations 14 and 15). Between them this takes the mixture
    (1 - λ) δ(π|M) + λ q(π|D); KL is convex in q, so the curve is convex in λ.

    Args:
        optimal: δ(π|M), [Π, M].
        models: q(M|D), [M].
        data: q(π|D), [Π].
        p: p(π|D), [Π].
        real_ratios: λ, [L].
    """
    ratio = real_ratios[:, None]
    return kl((1 - ratio) * marginal(optimal, models) + ratio * data, p)
