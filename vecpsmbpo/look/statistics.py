"""Statistics over few runs, as Agarwal et al. (2021, "Deep RL at the edge of the statistical precipice") define them.

Scores come as a sequence of tasks, each with an array of one score per run: [R_1], [R_2], ... The package rliable has
the same definitions; it brings arch, statsmodels and seaborn with it for four formulas, so they are written out here,
and tests hold them against SciPy and values worked by hand.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

Array = np.ndarray
Scores = Sequence[Array]

RESAMPLES = 2000  # rliable's own default is 50,000: its third digit is not worth the wait
CONFIDENCE = 0.95


class Estimate(NamedTuple):
    """A statistic and its interval; the interval is NaN where one run alone says nothing of it."""

    value: float
    low: float
    high: float


def interquartile_mean(scores: Scores) -> float:
    """The mean of the middle half of all scores of all tasks; a quarter, rounded down, is cut at either end."""
    return float(trimmed_mean(np.concatenate([np.ravel(task) for task in scores])))


def optimality_gap(scores: Scores) -> float:
    """By how much scores fall short of 1, on average; what lies above 1 does not make up for what lies below."""
    return float(1 - np.concatenate([np.minimum(task, 1.0) for task in scores]).mean())


def probability_of_improvement(scores: Scores, others: Scores) -> float:
    """How likely a run of the first scores higher than one of the second on the same task, averaged over tasks.

    Ties count half: this is the Mann-Whitney U statistic over the number of pairs.
    """
    return float(np.mean([_wins(one, other) for one, other in zip(scores, others, strict=True)]))


def _wins(one: Array, other: Array) -> float:
    differences = one[:, None] - other[None, :]
    # Means of the same returns, added up in another order or read from rounded numbers, are a tie.
    tied = np.isclose(one[:, None], other[None, :], rtol=1e-6, atol=0)
    won = np.where(tied, 0.5, differences > 0)
    return float(np.mean(np.where(np.isnan(differences), np.nan, won)))


def bootstrap(statistic: Callable[..., float], *samples: Scores, seed: int = 0, resamples: int = RESAMPLES) -> Estimate:
    """A statistic with its stratified bootstrap interval: runs are drawn with replacement within each task.

    Args:
        statistic: of as many `Scores` as there are `samples`.
        samples: of each algorithm, drawn independently of one another.
    """
    value = statistic(*samples)
    if any(len(task) < 2 for scores in samples for task in scores):
        return Estimate(value, np.nan, np.nan)
    random = np.random.default_rng(seed)
    drawn = [
        statistic(*([task[random.integers(len(task), size=len(task))] for task in scores] for scores in samples))
        for _ in range(resamples)
    ]
    tail = (1 - CONFIDENCE) / 2
    return Estimate(value, *map(float, np.quantile(drawn, (tail, 1 - tail))))


def trimmed_mean(values: Array, axis: int = 0) -> Array:
    """As `interquartile_mean`, along an axis; NaN where any value is (sorting would hide it at an end)."""
    unknown = np.isnan(values).any(axis=axis)
    values = np.sort(values, axis=axis)
    cut = values.shape[axis] // 4
    middle = np.take(values, range(cut, values.shape[axis] - cut), axis=axis)
    return np.where(unknown, np.nan, middle.mean(axis=axis))


def band(curves: Array, average: Callable[..., Array], seed: int = 0) -> tuple[Array, Array]:
    """The bootstrap interval of an average over seeds, at every point of their curves.

    Args:
        curves: [S, T].
        average: of an array, over its axis 0.

    Returns:
        Its lower and upper end, [T] each; NaN where there is one seed only.
    """
    seeds, points = curves.shape
    if seeds < 2:
        return np.full(points, np.nan), np.full(points, np.nan)
    draws = np.random.default_rng(seed).integers(seeds, size=(RESAMPLES, seeds))
    averages = np.stack([average(curves[draw], axis=0) for draw in draws])
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(averages, (tail, 1 - tail), axis=0)
    return low, high
