"""The paper's theory against values worked by hand, enumeration, linear programmes and simulation."""

import csv
import itertools
import math
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.stats

from vecpsmbpo.settings import SettingError
from vecpsmbpo.theory import example, report, tabular


def test_example_1_by_hand():
    degenerate = example.marginal(example.OPTIMAL, example.WRONG_MODELS)
    np.testing.assert_array_equal(degenerate, [0, 1])
    np.testing.assert_allclose(example.marginal(example.OPTIMAL, example.EQUATION_10), [2 / 3, 1 / 3])  # equation 10
    assert example.kl(degenerate, example.EQUATION_10) == pytest.approx(math.log(3))  # equation 12
    assert example.kl(degenerate, example.TEXT) == pytest.approx(math.log(1.5))  # 1 · log(1 / (2/3))
    equation_11 = np.array([[1 / 2, 2 / 3], [1 / 2, 1 / 3]])
    assert example.kl(example.marginal(equation_11, example.WRONG_MODELS), example.EQUATION_10) == pytest.approx(0)


def test_equation_12_is_the_largest_divergence_for_equation_10_only():
    simplex = np.linspace(0, 1, 1001)
    every_q = np.stack([simplex, 1 - simplex], axis=1)
    for p in (example.EQUATION_10, example.TEXT, np.array([0.02, 0.98])):
        assert example.largest_kl(p) == pytest.approx(example.kl(every_q, p).max())
    degenerate = example.marginal(example.OPTIMAL, example.WRONG_MODELS)
    assert example.kl(degenerate, example.EQUATION_10) == pytest.approx(example.largest_kl(example.EQUATION_10))
    assert example.kl(degenerate, example.TEXT) < example.largest_kl(example.TEXT)


def test_divergence_against_scipy():
    q, p = np.random.default_rng(0).dirichlet(np.ones(5), size=(2, 20))
    np.testing.assert_allclose(example.kl(q, p), scipy.stats.entropy(q, p, axis=1))
    assert example.kl(np.array([0.5, 0.5]), np.array([1.0, 0.0])) == math.inf


@pytest.mark.parametrize("seed", range(5))
def test_the_best_conditional_attains_zero_and_departs_least_from_the_optimal_policies(seed):
    """A linear programme over every q(π|M) with q(π|D) = p(π|D) finds no smaller departure from δ(π|M)."""
    rng = np.random.default_rng(seed)
    n_policies, n_models = 4, 6
    optimal = np.eye(n_policies)[:, rng.integers(n_policies, size=n_models)]
    models, p = rng.dirichlet(np.ones(n_models)), rng.dirichlet(np.ones(n_policies))
    best = example.best_conditional(optimal, models, p)
    assert best.min() >= 0
    np.testing.assert_allclose(best.sum(axis=0), 1)
    np.testing.assert_allclose(example.marginal(best, models), p)
    departure = (models * (1 - (best * optimal).sum(axis=0))).sum()
    # Unknowns q(π|M), row by row; columns sum to 1, and the marginal is p.
    columns = np.kron(np.ones(n_policies), np.eye(n_models))
    marginals = np.kron(np.eye(n_policies), models)
    programme = scipy.optimize.linprog(
        -(models * optimal).ravel(),
        A_eq=np.vstack([columns, marginals]),
        b_eq=np.concatenate([np.ones(n_models), p]),
    )
    assert departure == pytest.approx(1 + programme.fun, abs=1e-9)


def test_the_best_conditional_leaves_an_exact_posterior_alone():
    np.testing.assert_array_equal(
        example.best_conditional(example.OPTIMAL, example.EQUATION_10, example.EQUATION_10), example.OPTIMAL
    )


def test_lambda_curves_by_hand():
    """Example 1 with equation 10: q(π|D, λ) = (λ a, 1 - λ a) for q(π|D) = (a, 1 - a)."""
    ratios = np.linspace(0, 1, 3001)
    minima = {}
    for case in example.LAMBDA_CASES:
        curve = example.lambda_curve(example.OPTIMAL, case.models, case.data, example.EQUATION_10, ratios)
        assert curve.min() <= curve[0]  # Proposition 2
        assert np.diff(curve, 2).min() > -1e-9  # convex
        minima[case.name] = (ratios[curve.argmin()], curve.min(), curve[0])
    exact_data, uniform, other_way, exact_models = minima.values()
    assert exact_data == pytest.approx((1, 0, math.log(3)), abs=1e-9)
    # (1/2, 1/2) against (2/3, 1/3): log(3/4) / 2 + log(3/2) / 2.
    assert uniform == pytest.approx((1, math.log(9 / 8) / 2, math.log(3)), abs=1e-9)
    assert other_way == pytest.approx((2 / 3, 0, math.log(3)), abs=1e-3)
    assert exact_models == pytest.approx((0, 0, 0), abs=1e-9)


def test_policies_are_all_deterministic_ones():
    for steps in (1, 2, 3):
        found = {policy.tobytes() for policy in tabular.policies(steps)}
        assert len(found) == len(tabular.policies(steps)) == 2 * 4 ** (steps - 1)


def test_values_solve_the_bellman_equations():
    """V = (I - P)⁻¹ r over all (step, state) at once, and the best policy's value by backward induction."""
    chances = np.random.default_rng(0).uniform(size=(5, 3, 2, 2))
    candidates = tabular.policies(3)
    found = tabular.values(chances, candidates)
    for run, chance in enumerate(chances):
        for policy, value in zip(candidates, found[run], strict=True):
            transition, reward = np.zeros((6, 6)), np.zeros(6)
            for step, state in itertools.product(range(3), range(2)):
                up = chance[step, state, policy[step, state]]
                if step == 2:
                    reward[2 * step + state] = up
                else:
                    transition[2 * step + state, 2 * step + 2 : 2 * step + 4] = 1 - up, up
            assert np.linalg.solve(np.eye(6) - transition, reward)[0] == pytest.approx(value)
        assert found[run].max() == pytest.approx(_plan(chance)[1])


def _plan(chance) -> tuple[np.ndarray, float]:
    """The optimal policy [H, S] and its value, by backward induction."""
    value, policy = np.array([0.0, 1.0]), np.zeros(chance.shape[:2], int)
    for step in reversed(range(len(chance))):
        q_values = chance[step] * value[1] + (1 - chance[step]) * value[0]
        policy[step], value = q_values.argmax(axis=1), q_values.max(axis=1)
    policy[0, 1] = 0  # cannot occur
    return policy, value[0]


@pytest.mark.parametrize("steps", [1, 2, 3])
@pytest.mark.parametrize("real_ratio", [0.0, 0.4])
def test_policy_distribution_is_that_of_the_policies_optimal_for_drawn_models(steps, real_ratio):
    rng = np.random.default_rng(steps)
    counts = rng.integers(0, 8, size=(1, steps, 2, 2, 2))
    counts[0, -1, 0, 1] = 0  # never tried
    mass = tabular.Marginals(tabular.EXACT, real_ratio, 8)(counts)
    probabilities = tabular.policy_distribution(mass)[0]
    assert probabilities.sum() == pytest.approx(1)

    draws = 20_000
    zeros, ones = counts[0, ..., 0], counts[0, ..., 1]
    tried = np.maximum(zeros + ones, 1)
    ratio = np.where(zeros + ones > 0, real_ratio, 0)
    models = (1 - ratio) * rng.beta(1 + ones, 1 + zeros, size=(draws, steps, 2, 2)) + ratio * ones / tried
    order = {policy.tobytes(): index for index, policy in enumerate(tabular.policies(steps))}
    best = [order[_plan(model)[0].tobytes()] for model in models]
    expected = np.bincount(best, minlength=len(order)) / draws
    error = np.sqrt(probabilities * (1 - probabilities) / draws)
    assert (np.abs(expected - probabilities) <= 4.5 * error + 1e-3).all()


def test_a_prior_draw_makes_every_policy_equally_likely():
    mass = tabular.Marginals(tabular.EXACT, 0.0, 1)(np.zeros((1, 2, 2, 2, 2), int))
    np.testing.assert_allclose(tabular.policy_distribution(mass), 1 / 8)


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        # θ_1 ~ Beta(2, 1) above θ_0 ~ Beta(1, 1): ∫ 2v · v dv.
        (([0, 0], [0, 1]), 2 / 3),
        # Beta(1, 1 + n) above Beta(1 + n, 1), n = 30: ∫ (n+1) (1-v)^n v^(n+1) dv = (n+1) B(n+2, n+1).
        (([0, 30], [30, 0]), 31 * math.exp(math.lgamma(32) + math.lgamma(31) - math.lgamma(63))),
    ],
)
def test_probabilities_by_hand_down_to_small_ones(counts, expected):
    both_states = np.array([[[counts, counts]]])  # [R, H, S, A, 2]
    mass = tabular.Marginals(tabular.EXACT, 0.0, 30)(both_states)
    assert tabular.policy_distribution(mass)[0, 1] == pytest.approx(expected, rel=5e-2 if expected < 1e-9 else 1e-3)


def test_the_grid_is_fine_enough_for_the_narrowest_posteriors_of_the_experiment():
    """Two arms of 150 trials with means 0.5 and 0.56, against scipy's quadrature."""
    arms = np.array([[[[[75, 75], [66, 84]], [[75, 75], [66, 84]]]]])
    found = tabular.policy_distribution(tabular.Marginals(tabular.EXACT, 0.0, 150)(arms))[0, 0]
    low, high = scipy.stats.beta(76, 76), scipy.stats.beta(85, 67)
    expected, _ = scipy.integrate.quad(lambda v: low.pdf(v) * high.cdf(v), 0, 1, points=[0.5, 0.56])
    assert found == pytest.approx(expected, abs=2e-3)


def test_grid_mass_against_scipy_and_its_mean():
    edges = np.linspace(0, 1, tabular.GRID + 1)
    mass = tabular.grid_mass(3.0, 9.0, 2, 8, 0.0)
    np.testing.assert_allclose(mass, np.diff(scipy.stats.beta(3, 9).cdf(edges)), atol=1e-12)
    mixed = tabular.grid_mass(3.0, 9.0, 2, 8, 0.3)
    np.testing.assert_allclose(mixed, np.diff(scipy.stats.beta(3, 9, loc=0.3 * 0.2, scale=0.7).cdf(edges)), atol=1e-12)
    np.testing.assert_allclose(tabular.grid_mass(1.0, 1.0, 0, 0, 0.7), 1 / tabular.GRID)  # nothing real to mix in


def test_lambda_1_is_greedy_in_the_frequencies_whatever_the_model():
    counts = np.zeros((2, 1, 2, 2, 2), int)
    counts[0, 0, 0] = [[3, 1], [1, 1]]  # action 0: 1/4, action 1: 1/2
    counts[1, 0, 0] = [[2, 2], [1, 1]]  # a tie
    for belief in (tabular.EXACT, *tabular.WRONG):
        found = tabular.policy_distribution(tabular.Marginals(belief, 1.0, 3)(counts))
        np.testing.assert_allclose(found, [[0, 1], [0.5, 0.5]])


def test_the_wrong_beliefs_by_hand():
    # Action 0 and action 1, each 4 times to state 1 and 2 times to state 0.
    counts = np.array([0, 1]), np.array([4, 4]), np.array([2, 2])
    wide, narrow, biased = (np.stack(belief.parameters(*counts), axis=1) for belief in tabular.WRONG)
    np.testing.assert_allclose(wide, [[1.4, 1.2], [1.4, 1.2]])
    np.testing.assert_allclose(narrow, [[41, 21], [41, 21]])
    np.testing.assert_allclose(biased, [[3, 5], [5, 3]])


@pytest.fixture(scope="module")
def world():
    return tabular.World.draw(3, runs=400, episodes=25, steps=2)


@pytest.fixture(scope="module")
def truth():
    return tabular.Marginals(tabular.EXACT, 0.0, 25)


@pytest.fixture(scope="module")
def exact(world, truth):
    return tabular.psrl(world, tabular.EXACT, 0.0, truth)


def test_exact_psrl_has_no_second_term_and_learns(exact):
    np.testing.assert_array_equal(exact.kl, 0)
    assert exact.regret.min() > -1e-12
    assert exact.regret.max() <= 1
    assert exact.regret[-5:].mean() < 0.6 * exact.regret[:5].mean()
    assert tabular.second_term(exact.kl, steps=2)[1] == (0, 0)


def test_the_first_episode_is_a_policy_drawn_uniformly(world, exact):
    payoff = tabular.values(world.chances, tabular.policies(2))
    np.testing.assert_allclose(exact.regret[0], payoff.max(axis=1) - payoff.mean(axis=1))


def test_every_step_of_every_episode_is_counted(exact):
    per_step = exact.counts.sum(axis=(2, 3, 4))
    np.testing.assert_array_equal(per_step, 25)
    # An episode is in state 1 at the second step where the first step led there.
    np.testing.assert_array_equal(exact.counts[:, 0, :, :, 1].sum(axis=(1, 2)), exact.counts[:, 1, 1].sum(axis=(1, 2)))
    assert exact.counts[:, 0, 1].sum() == 0


def test_the_exact_posterior_is_calibrated(world, exact, truth):
    """P(π* = π | D) = p(π|D): over MDPs from the prior, p of the policy that is truly best averages Σ p²."""
    best = tabular.values(world.chances, tabular.policies(2)).argmax(axis=1)
    p = tabular.policy_distribution(truth(exact.counts))
    excess = p[np.arange(len(best)), best] - (p**2).sum(axis=1)
    assert abs(excess.mean()) < 4 * excess.std() / math.sqrt(len(best))
    wide = tabular.policy_distribution(tabular.Marginals(tabular.WRONG[0], 0.0, 25)(exact.counts))
    excess = wide[np.arange(len(best)), best] - (wide**2).sum(axis=1)
    assert excess.mean() > 4 * excess.std() / math.sqrt(len(best))  # a posterior that is too wide is not


def test_a_posterior_that_is_too_wide_costs_regret_and_lambda_wins_some_back(world, exact, truth):
    wide = tabular.WRONG[0]
    regret = [exact.regret.sum(axis=0)]
    regret += [tabular.psrl(world, wide, ratio, truth).regret.sum(axis=0) for ratio in (0.0, 0.5)]
    for better, worse in ((0, 1), (2, 1)):
        difference = tabular.Estimate.of(regret[worse] - regret[better])
        assert difference.value > 4 * difference.error


def test_lambda_curve_starts_at_the_degenerate_posterior_and_forgets_the_model(exact, truth):
    p = tabular.policy_distribution(truth(exact.counts))
    ends = []
    for belief in (tabular.EXACT, *tabular.WRONG):
        curve = tabular.lambda_curve(exact.counts, belief, np.array([0.0, 0.5, 1.0]))
        degenerate = tabular.policy_distribution(tabular.Marginals(belief, 0.0, 25)(exact.counts))
        assert curve[0] == pytest.approx(np.mean([scipy.stats.entropy(*pair) for pair in zip(degenerate, p)]))  # noqa: B905
        ends.append(curve[2])
    np.testing.assert_allclose(ends, ends[0])


def test_second_term_by_hand():
    # H = 2: 2 · 2 · (√0.25 + √1), where 0.25 and 1 are the means over two runs.
    divergence = np.array([[0.0, 0.5], [1.0, 1.0]])
    terms, last = tabular.second_term(divergence, steps=2)
    np.testing.assert_allclose(terms, [2, 6])
    # The error of the mean 0.25 is 0.25; the slope of 4 √x there is 4.
    assert last == pytest.approx((6, 1.0))


def test_first_term_by_hand():
    # |Π| = 8: √(8 · 50 · 2² · log 8).
    assert tabular.first_term(50, 2) == pytest.approx(math.sqrt(1600 * math.log(8)))


def test_the_command_writes_a_table_and_a_figure(tmp_path, capsys):
    assert report.run([f"out={tmp_path}/a/b", "episodes=12", "runs=5", "seed=4"]) == 0
    printed = capsys.readouterr().out
    for text in ("log 3", "log 3/2", "too wide", "biased", "first term", "theory.svg"):
        assert text in printed
    rows = list(csv.DictReader((tmp_path / "a/b/theory.csv").open()))
    example_1 = {(row["case"], row["quantity"]): float(row["value"]) for row in rows if row["part"] == "example_1"}
    assert example_1["equation 10", "kl_degenerate"] == pytest.approx(math.log(3), abs=1e-5)
    assert example_1["text", "kl_degenerate"] == pytest.approx(math.log(1.5), abs=1e-5)
    regret = [row for row in rows if row["part"] == "tabular" and row["quantity"] == "regret"]
    arms = {(row["case"], row["real_ratio"]) for row in regret}
    assert len(arms) == 4 * 4 + 1  # four posteriors at λ < 1, and λ = 1
    assert len(regret) == 12 * len(arms)
    root = ElementTree.parse(tmp_path / "a/b/theory.svg").getroot()
    written = [text.text for text in root.findall(".//{*}text")]
    assert sum(written.count(f"λ = {ratio:g}") for ratio in report.REAL_RATIOS) == len(report.REAL_RATIOS)
    for panel in ("Proposition 2 in Example 1", "Regret of the degenerate posterior", "Theorem 1's second term"):
        assert panel in written
    bands = [element for element in root.findall(".//{*}g") if element.get("id", "").startswith("FillBetween")]
    assert len(bands) == 5 + 4 + 4 + 5  # the regret's and the second term's, which are estimates


def test_the_command_repeats_itself(tmp_path, capsys):
    for name in "ab":
        report.run([f"out={tmp_path}/{name}", "episodes=2", "runs=2"])
    for file in ("theory.csv", "theory.svg"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("episodes", "episodes: must be name=value"),
        ("episode=3", "episode=3: no such option of theory; did you mean episodes?"),
        ("episodes=1", "episodes=1: must be a whole number from 2 to 500"),
        ("runs=many", "runs=many: must be a whole number from 2 to 100000"),
        ("seed=-1", "seed=-1: must be a whole number from 0 to 2147483647"),
        ("out=", "out=: must be a directory"),
    ],
)
def test_a_mistake_is_one_line_and_creates_nothing(override, line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingError) as error:
        report.run([override])
    assert str(error.value) == line
    assert not list(tmp_path.iterdir())


def test_a_directory_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SettingError, match=r"cannot be written \(Not a directory\)"):
        report.run([f"out={tmp_path}/file/theory"])


def test_what_was_there_stays_where_the_disk_is_full(tmp_path, monkeypatch, capsys):
    def full(path, text, **kwargs):
        path.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(tmp_path), "write_text", full)
    (tmp_path / "theory.csv").write_bytes(b"before")
    with pytest.raises(SettingError, match=r"theory.csv: cannot be written \(No space left on device\)"):
        report.run([f"out={tmp_path}", "episodes=2", "runs=2"])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"theory.csv": b"before"}


def test_the_theory_does_not_import_jax():
    code = "import sys, vecpsmbpo.theory.report; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
