"""PSRL in a tabular MDP where p_k(π), q_k(π), their KL and the regret of an episode need no sampling.

The MDP: two states, two actions, H steps. An episode starts in state 0 and wins 1 if it ends in state 1, so reward is
sparse and r(s_H, a_H) = P_H(1 | s_H, a_H). Unknown are the transitions P_h(1 | s, a), each step with its own. Their
prior is Dirichlet(1, 1), independently; with two successors that is a Beta, and so is the exact posterior. π(M) is the
best of the 2 · 4^(H-1) deterministic policies.

q(π|D, λ) is Algorithm 1's line 11 in a table: a model is drawn, and the policy is optimal for
(1 - λ) P_model + λ P_real, where P_real are the frequencies in D_E. An (s, a) that was never tried has no real rows, so
the model stands alone there. λ = 0 is q^δ, equation 14. λ = 1 reads no model, equation 15: what was never tried is then
worth a uniform draw, as an untrained critic's value is arbitrary.

Axes: R runs, K episodes, H steps, S states, A actions, Π policies, G cells of a grid over [0, 1].
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import betainc

from vecpsmbpo.theory.example import kl

Array = np.ndarray

STATES = ACTIONS = 2
GRID = 100


class Belief(NamedTuple):
    """A rule that turns data into a posterior over models, q(M|D).

    Attributes:
        name: for the table.
        parameters: (action, ones, zeros) -> the Beta's two parameters, given how often the action led to state 1 and
            to state 0; arrays of one shape.
        meaning: in words.
    """

    name: str
    parameters: Callable[[Array, Array, Array], tuple[Array, Array]]
    meaning: str


def _biased(action: Array, ones: Array, zeros: Array) -> tuple[Array, Array]:
    misread = np.where(action == 0, 0.5 * ones, 0.0)
    return 1 + ones - misread, 1 + zeros + misread


EXACT = Belief("exact", lambda _, ones, zeros: (1 + ones, 1 + zeros), "Dirichlet(1 + counts)")
# Three ways to be wrong, because λ acts differently on each: no spread to trust, too little of it, a wrong place.
WRONG = (
    Belief("too wide", lambda _, ones, zeros: (1 + ones / 10, 1 + zeros / 10), "ten observations count as one"),
    Belief("too narrow", lambda _, ones, zeros: (1 + ones * 10, 1 + zeros * 10), "one observation counts as ten"),
    Belief("biased", _biased, "half of the moves to state 1 under action 0 are read as moves to state 0"),
)


class World(NamedTuple):
    """What chance decides, drawn once, so that every algorithm meets the same MDPs and the same luck.

    Attributes:
        chances: P_h(1 | s, a) of the real MDP of each run, drawn from the prior, [R, H, S, A].
        step_draws: uniform; state 1 follows where it is below the chance, [K, R, H].
        policy_draws: uniform; picks the policy, [K, R].
    """

    chances: Array
    step_draws: Array
    policy_draws: Array

    @classmethod
    def draw(cls, seed: int, *, runs: int, episodes: int, steps: int) -> "World":
        rng = np.random.default_rng(seed)
        chances = rng.uniform(size=(runs, steps, STATES, ACTIONS))
        return cls(chances, rng.uniform(size=(episodes, runs, steps)), rng.uniform(size=(episodes, runs)))


class Outcome(NamedTuple):
    """What one algorithm did in every run.

    Attributes:
        regret: E[Δ_k | D_k, M], equation 3, the mean over π ~ q_k of V_{π*} - V_π in the real MDP, [K, R].
        kl: d_KL(q_k(π) | p_k(π)), [K, R].
        counts: how often (step, state, action) led to state 0 and 1, at the end, [R, H, S, A, 2].
    """

    regret: Array
    kl: Array
    counts: Array


def policies(steps: int) -> Array:
    """Every deterministic policy, [Π, H, S] actions, in the order of `policy_distribution`.

    State 1 cannot occur at the first step; its action there is written 0.
    """
    free = np.indices((ACTIONS,) * (1 + STATES * (steps - 1))).reshape(1 + STATES * (steps - 1), -1).T
    first = np.stack([free[:, 0], np.zeros_like(free[:, 0])], axis=-1)
    return np.concatenate([first[:, None], free[:, 1:].reshape(len(free), steps - 1, STATES)], axis=1)


def values(chances: Array, candidates: Array) -> Array:
    """R_M(π), equation 2: the probability that each policy wins in each MDP.

    Shapes: chances [R, H, S, A], candidates [Π, H, S] -> [R, Π].
    """
    value = np.broadcast_to(np.array([0.0, 1.0]), (len(chances), len(candidates), STATES))
    for step in reversed(range(chances.shape[1])):
        up = np.stack([chances[:, step, s][:, candidates[:, step, s]] for s in range(STATES)], axis=-1)
        value = up * value[..., 1:] + (1 - up) * value[..., :1]
    return value[..., 0]


def grid_mass(first: Array, second: Array, ones: Array, zeros: Array, real_ratio: float) -> Array:
    """The distribution of (1 - λ) θ + λ ones / (ones + zeros) with θ ~ Beta(first, second), in G cells, [..., G].

    Args:
        first, second: the model's Beta parameters, [...].
        ones, zeros: the real data, [...]; where both are 0, λ counts as 0.
        real_ratio: λ.
    """
    first, second, ones, zeros = (np.asarray(x, float)[..., None] for x in (first, second, ones, zeros))
    tried = ones + zeros > 0
    frequency = ones / np.maximum(ones + zeros, 1)
    if real_ratio == 1:
        cell = np.minimum(frequency * GRID, GRID - 1).astype(int)
        return np.where(tried, np.arange(GRID) == cell, 1 / GRID)
    ratio = np.where(tried, real_ratio, 0.0)
    edges = np.clip((np.linspace(0, 1, GRID + 1) - ratio * frequency) / (1 - ratio), 0, 1)
    # Each side of the mean is measured from its own end, so that both tails are exact: p_k(π) of a policy that is all
    # but excluded is a product of tails, and its logarithm enters the KL.
    left = edges < first / (first + second)
    tail = betainc(np.where(left, first, second), np.where(left, second, first), np.where(left, edges, 1 - edges))
    return np.diff(np.where(left, tail, -tail), axis=-1) + (left[..., :-1] & ~left[..., 1:])


class Marginals:
    """The distribution of each P_h(1 | s, a) given its counts, for one belief and one λ.

    Counts are small whole numbers that recur over runs and episodes: each pair is integrated once.
    """

    def __init__(self, belief: Belief, real_ratio: float, episodes: int):
        self._belief, self._ratio = belief, real_ratio
        self._shape = (ACTIONS, episodes + 1, episodes + 1)
        self._row = np.full(np.prod(self._shape), -1)  # of a pair in the table
        self._table, self._filled = np.empty((1024, GRID)), 0

    def __call__(self, counts: Array) -> Array:
        """[R, H, S, A, 2] counts -> [R, H, S, A, G]."""
        action = np.broadcast_to(np.arange(ACTIONS), counts.shape[:-1])
        pair = np.ravel_multi_index((action, counts[..., 1], counts[..., 0]), self._shape)
        row = self._row.take(pair)
        if (row < 0).any():
            self._integrate(np.unique(pair[row < 0]))
            row = self._row.take(pair)
        return self._table.take(row, axis=0)

    def _integrate(self, pairs: Array) -> None:
        action, ones, zeros = np.unravel_index(pairs, self._shape)
        end = self._filled + len(pairs)
        if end > len(self._table):
            self._table = np.concatenate([self._table[: self._filled], np.empty((end, GRID))])
        parameters = self._belief.parameters(action, ones, zeros)
        self._table[self._filled : end] = grid_mass(*parameters, ones, zeros, self._ratio)
        self._row[pairs] = np.arange(self._filled, end)
        self._filled = end


def policy_distribution(mass: Array) -> Array:
    """The distribution of π(M) where the P_h(1 | s, a) are independent, [R, Π].

    With two states only one fact about the later steps matters: which state is worth more, x. If state 1 is, the best
    action has the largest P_h(1 | s, a), else the smallest; and the state whose best action reaches x more often is
    itself worth more. So the joint distribution of the actions and x is a chain from the last step to the first, each
    link an integral over one number. Numbers in one cell of the grid are a tie, decided by a coin.

    Args:
        mass: distribution of each P_h(1 | s, a), [R, H, S, A, G]; nothing is read of state 1 at the first step.
    """
    runs, steps = mass.shape[:2]
    link = _link(mass[:, -1], 1)[:, None]  # [R, later x, x, A, A]; at the end, state 1 wins
    chain = np.ones((runs, 1, 1))  # [R, later x, Π of the later steps]
    for step in reversed(range(1, steps)):
        if step < steps - 1:
            link = np.stack([_link(mass[:, step], x) for x in range(STATES)], axis=1)
        chain = np.einsum("ryxab,ryp->rxabp", link, chain).reshape(runs, STATES, -1)
    first = mass[:, 0, 0]
    largest = (first * _below(first)[:, ::-1]).sum(axis=-1)  # [R, A], P(the action has the larger number)
    if steps == 1:
        return largest
    wanted = np.stack([largest[:, ::-1], largest], axis=1)  # [R, x, A]
    return np.einsum("rxa,rxp->rap", wanted, chain).reshape(runs, -1)


def _link(mass: Array, later: int) -> Array:
    """P(the best actions of both states, which state is worth more | `later` is worth more a step later).

    Shapes: mass [R, S, A, G] -> [R, x, A of state 0, A of state 1].
    """
    rival = _below(mass) if later == 1 else _above(mass)
    density = mass * rival[:, :, ::-1]  # of a state's best number, where action a attains it
    state_0, state_1 = density[:, 0], density[:, 1].swapaxes(-1, -2)
    smaller, larger = _above(state_0) @ state_1, _below(state_0) @ state_1  # state 1 has the smaller, larger number
    # Going more often to the state worth less makes a state worth less.
    return np.stack([smaller, larger] if later == 1 else [larger, smaller], axis=1)


def _below(mass: Array) -> Array:
    """P(number < each cell) + half of P(number in it)."""
    return np.cumsum(mass, axis=-1) - 0.5 * mass


def _above(mass: Array) -> Array:
    """P(number > each cell) + half of P(number in it); not 1 - `_below`, which would lose a small one."""
    return np.cumsum(mass[..., ::-1], axis=-1)[..., ::-1] - 0.5 * mass


def psrl(world: World, belief: Belief, real_ratio: float, truth: Marginals) -> Outcome:
    """Posterior sampling, Algorithm 2, with q(π|D, λ) from `belief`, in every run at once.

    Args:
        truth: of the exact posterior at λ = 0, for p(π|D); shared, since what it has integrated serves again.
    """
    episodes, runs, steps = world.step_draws.shape
    candidates = policies(steps)
    payoff = values(world.chances, candidates)
    approximate = Marginals(belief, real_ratio, episodes)
    counts = np.zeros((runs, steps, STATES, ACTIONS, 2), int)
    regret, divergence = np.empty((2, episodes, runs))
    every_run = np.arange(runs)
    for episode in range(episodes):
        p, q = policy_distribution(truth(counts)), policy_distribution(approximate(counts))
        divergence[episode] = kl(q, p)
        regret[episode] = payoff.max(axis=1) - (q * payoff).sum(axis=1)
        passed = np.cumsum(q, axis=1) < world.policy_draws[episode][:, None]
        acting = candidates[np.minimum(passed.sum(axis=1), len(candidates) - 1)]
        state = np.zeros(runs, int)
        for step in range(steps):
            action = acting[every_run, step, state]
            chance = world.chances[every_run, step, state, action]
            next_state = (world.step_draws[episode, :, step] < chance).astype(int)
            counts[every_run, step, state, action, next_state] += 1
            state = next_state
    return Outcome(regret, divergence, counts)


def lambda_curve(counts: Array, belief: Belief, real_ratios: Array) -> Array:
    """d_KL(q(π|D, λ) | p(π|D)) of equation 16 on given data: the mean over runs, for every λ, [L].

    Args:
        counts: the data of each run, [R, H, S, A, 2].
        belief: gives q(M|D).
        real_ratios: λ, [L].
    """
    most = int(counts.max())
    p = policy_distribution(Marginals(EXACT, 0.0, most)(counts))
    curve = [kl(policy_distribution(Marginals(belief, ratio, most)(counts)), p).mean() for ratio in real_ratios]
    return np.array(curve)


class Estimate(NamedTuple):
    """A mean over runs and its standard error."""

    value: float
    error: float

    @classmethod
    def of(cls, samples: Array) -> "Estimate":
        return cls(float(samples.mean()), float(samples.std(ddof=1) / np.sqrt(len(samples))))


def first_term(episodes: int, steps: int) -> float:
    """Theorem 1's first term, √(C K (H R_max)² H(π*)), with R_max = 1.

    Every policy is equally likely to be the best under the prior, so H(π*) = log |Π|. C is bounded by |Π|: equation 65
    divides the square of the sum of |Π| diagonal entries by the sum of all squares (Cauchy-Schwarz).
    """
    count = len(policies(steps))
    return float(np.sqrt(count * episodes * steps**2 * np.log(count)))


def second_term(divergence: Array, steps: int) -> tuple[Array, Estimate]:
    """Theorem 1's second term, 2 H R_max Σ_k √E[d_KL(q_k | p_k)], with R_max = 1.

    Args:
        divergence: d_KL(q_k | p_k), [K, R]. The expectation is over the MDP, luck and policies: the mean over runs.
        steps: H.

    Returns:
        The sum up to each episode, [K], and the last one with its standard error (delta method).
    """
    root = np.sqrt(divergence.mean(axis=1))
    slope = np.divide(0.5, root, out=np.zeros_like(root), where=root > 0)  # of the square root
    per_run = (slope[:, None] * (divergence - divergence.mean(axis=1, keepdims=True))).sum(axis=0)
    terms = 2 * steps * np.cumsum(root)
    return terms, Estimate(float(terms[-1]), 2 * steps * Estimate.of(per_run).error)
