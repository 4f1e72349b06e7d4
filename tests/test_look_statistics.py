"""Averages over seeds, their intervals, and the curves and tables made of them."""

import numpy as np
import pytest
from scipy import stats

from tests import looks
from vecpsmbpo.look import compare, curves, groups, runs, statistics

# ── statistics ──────────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 11, 100])
def test_the_interquartile_mean_is_scipy_s_trimmed_mean(count):
    scores = np.random.default_rng(count).normal(size=(2, count))
    expected = stats.trim_mean(scores, 0.25, axis=None)
    assert statistics.interquartile_mean(list(scores)) == pytest.approx(expected)
    np.testing.assert_allclose(statistics.trimmed_mean(scores, axis=1), stats.trim_mean(scores, 0.25, axis=1))


def test_statistics_by_hand():
    one, other = [np.array([0.2, 0.8]), np.array([1.5, 0.5])], [np.array([0.2, 0.4]), np.array([2.0, 3.0])]
    assert statistics.optimality_gap(one) == pytest.approx(1 - (0.2 + 0.8 + 1.0 + 0.5) / 4)
    # Pairs: 0.2 against 0.2 is a tie, against 0.4 a loss; 0.8 wins twice; the second task is lost throughout.
    assert statistics.probability_of_improvement(one, other) == pytest.approx((2.5 / 4 + 0) / 2)
    assert statistics.probability_of_improvement(one, one) == 0.5


def test_scores_that_differ_by_rounding_alone_are_tied():
    one, other = np.array([0.1 + 0.2, 0.0]), np.array([0.3, 0.0])
    assert one[0] != other[0]
    assert statistics.probability_of_improvement([one], [other]) == (0.5 + 1 + 0 + 0.5) / 4


def test_the_probability_of_improvement_is_mann_whitney_s(tmp_path):
    random = np.random.default_rng(0)
    one, other = random.normal(0.3, 1, 9), random.normal(0, 1, 7)
    expected = stats.mannwhitneyu(one, other).statistic / (9 * 7)
    assert statistics.probability_of_improvement([one], [other]) == pytest.approx(expected)


def test_what_is_not_known_is_not_trimmed_away():
    scores = [np.array([1.0, 2.0, np.nan, 3.0])]
    assert np.isnan(statistics.interquartile_mean(scores))
    assert np.isnan(statistics.optimality_gap(scores))
    assert np.isnan(statistics.probability_of_improvement(scores, [np.zeros(2)]))


def _mean(scores):
    return float(np.mean(np.concatenate(scores)))


def test_the_bootstrap_s_interval_is_that_of_a_normal_mean():
    sample = np.random.default_rng(1).normal(5, 2, 400)
    estimate = statistics.bootstrap(_mean, [sample], resamples=4000)
    error = 1.96 * sample.std(ddof=1) / 20
    np.testing.assert_allclose([estimate.low, estimate.high], sample.mean() + np.array([-error, error]), atol=0.03)


def test_the_bootstrap_is_stratified():
    """Runs are drawn within their task: scores that differ between tasks only have an interval of no width."""
    estimate = statistics.bootstrap(_mean, [np.full(5, 0.1), np.full(5, 0.9)])
    assert estimate == pytest.approx((0.5, 0.5, 0.5))


def test_one_run_has_no_interval():
    assert np.isnan(statistics.bootstrap(statistics.interquartile_mean, [np.array([3.0])]).low)
    assert np.isnan(statistics.band(np.ones((1, 4)), np.mean)).all()


# ── curves and tables ───────────────────────────────────────────────────────────────────────────────────────────────


def test_a_seed_that_was_frozen_before_it_had_a_value_is_left_out(tmp_path):
    """Its group is that of the others, and readers are told."""
    early = dict.fromkeys(looks.epochs([0])[0]) | {"env_steps": 20, "seed": 1, "frozen": True}
    lines = [*looks.epochs([1, 2, 3]), early, *looks.epochs([3, 4, 5], seed=2)]
    one = looks.write(tmp_path / "one", lines, num_seeds=3)
    found = runs.load_all([one])
    (group,) = groups.group(found)
    found_curve = curves.curve(group, "env_steps", "eval_return")
    np.testing.assert_array_equal(found_curve.y, [2, 3, 4])
    assert found_curve.seeds.shape == (2, 3)
    (row,) = compare.table(found, looks.options())
    assert (len(row.scores["cartpole_swingup"]), row.frozen, row.cells["best"].value) == (2, 1, 4)
    assert list(runs.warnings(found)) == [
        f"{one}: seed 1 was frozen at step 20; no average has it, as it has no evaluation"
    ]
    assert groups.averaged([group], "mean of", "band") == "mean of 2 seeds, band"


def test_a_frozen_seed_counts_with_what_it_had_reached_and_a_slow_one_ends_the_curve(mixed):
    ops, ps = (curves.curve(group, "env_steps", "eval_return") for group in groups.group(runs.load_all(mixed)))
    np.testing.assert_array_equal(ops.x, [40, 80, 120])
    np.testing.assert_array_equal(ops.y, [3, 4, 4.5])
    np.testing.assert_array_equal(ops.seeds[1], [5, 6, 6])
    np.testing.assert_array_equal(ps.x, [40, 80])
    np.testing.assert_array_equal(ps.y, [1, 2])
    assert ops.low[0] == 1
    assert ops.high[0] == 5


def test_an_epoch_without_a_value_counts_as_the_one_before(tmp_path):
    lines = looks.epochs([1, 2, 3, 4])
    lines[2]["eval_return"] = None
    lanes = lines + looks.epochs([1, 1, 1, 1], seed=1)
    (group,) = groups.group([runs.load(looks.write(tmp_path / "a", lanes, num_seeds=2))])
    np.testing.assert_array_equal(curves.curve(group, "env_steps", "eval_return").seeds[0], [1, 2, 2, 4])
    smooth = curves.curve(group, "env_steps", "alpha", smooth=2)
    np.testing.assert_allclose(smooth.y, 0.1)


def test_smoothing_is_a_mean_of_the_last_epochs(tmp_path):
    (group,) = groups.group([runs.load(looks.write(tmp_path / "a", looks.epochs([1, 2, 6])))])
    np.testing.assert_allclose(curves.curve(group, "env_steps", "eval_return", smooth=2).y, [1, 1.5, 4])


def test_scores_of_a_seed_by_hand(mixed):
    ops, _ = runs.load_all(mixed)
    seed = compare.score(ops.lanes[0], 120, looks.options(window=2, threshold=2.0))
    assert seed == compare.Seed(final=2.5, best=3, area=2, reached=80, seconds=6)
    frozen = compare.score(ops.lanes[1], 120, looks.options(window=2, threshold=7.0))
    assert (frozen.final, frozen.best, frozen.area, frozen.reached) == (6, 6, pytest.approx(17 / 3), np.inf)


def test_the_table(mixed):
    rows = compare.table(runs.load_all(mixed), looks.options(window=1, target=10.0))
    assert [(row.name, row.env_steps, row.frozen) for row in rows] == [("OPS-MBPO", 80, 1), ("PS-MBPO", 80, 0)]
    ops, ps = (row.cells for row in rows)
    assert ops["final"].value == 4  # of 2 and 6
    assert ops["optimality gap"].value == pytest.approx(1 - 0.4)
    assert ops["P(better)"].value == 0.75  # 2 is above 1 and below 3, 6 above both
    assert "P(better)" not in ps


def test_tasks_together_are_scaled(tmp_path):
    """Half of cartpole's 25 most possible (episodes have 25 steps) and a quarter of hopper's 3809."""
    for env, value in (("cartpole_swingup", 12.5), ("hopper", 3809 / 4)):
        for algo in ("ops_mbpo", "sac"):
            looks.write(tmp_path / f"{env}-{algo}", looks.epochs([value, value]), env=env, algo=algo)
    rows = compare.table(runs.load_all(sorted(tmp_path.iterdir())), looks.options())
    assert [row.task for row in rows].count("all 2 tasks, scaled") == 2
    assert rows[-1].cells["final"].value == pytest.approx((1 / 2 + 1 / 4) / 2)
    assert rows[-1].cells["optimality gap"].value == pytest.approx(5 / 8)
