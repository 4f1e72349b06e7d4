"""λ that moves: the linear schedule of figure 13, and the bandit of B.3 that chooses it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from tests.helpers import tiny
from vecpsmbpo import mixing
from vecpsmbpo.types import Hyper


@pytest.mark.parametrize("mean", [0.05, 0.3, 0.5, 0.8])
def test_the_linear_schedule_has_the_constant_s_area(mean):
    progress = jnp.linspace(0, 1, 100_001)
    ratio = np.asarray(mixing.linear(jnp.float32(mean), progress))
    assert np.trapezoid(ratio, progress) == pytest.approx(mean, abs=1e-3)
    assert ratio[0] == 1
    assert ratio[-1] == pytest.approx(0, abs=1e-6)
    assert (np.diff(ratio) <= 1e-6).all()
    falling = ratio[(ratio > 0.01) & (ratio < 0.99)]
    assert np.ptp(np.diff(falling)) < 1e-5  # a straight line


@pytest.mark.parametrize("mean", [0.05, 0.3, 0.8])
def test_of_a_run_s_updates_the_linear_schedule_uses_as_many_real_rows_as_the_constant(mean):
    """Nothing is learned during the warm-up, here a third of the run: the line begins after it."""
    settings = tiny(
        real_ratio_schedule="linear", real_ratio=mean, total_steps=12_000, warmup_steps=4_000, replay_capacity=5000
    )
    hyper, steps = Hyper.of(settings), jnp.arange(settings.first_learning_step, settings.total_steps)
    ratios = jax.vmap(lambda t: mixing.real_ratios(settings, hyper, None, t)[0])(steps)
    assert float(ratios.mean()) == pytest.approx(mean, abs=1e-3)
    assert float(ratios[0]) == 1


@pytest.mark.parametrize("mean", [0.0, 1.0])
def test_the_linear_schedule_of_no_or_only_real_data_is_constant(mean):
    np.testing.assert_allclose(mixing.linear(jnp.float32(mean), jnp.array([0.01, 0.5, 0.99])), mean)


ARMS = (0.0, 0.1, 0.3, 0.5)


def _bandit(gains, counts):
    """A range of 0 to 1."""
    numbers = (jnp.asarray(x, jnp.float32) for x in (gains, counts))
    return mixing.Bandit(*numbers, jnp.int32(10), jnp.float32(0.0), jnp.float32(1.0))


def _credited(*episodes):
    """What is known of four arms after these: arm and return each."""
    bandit = mixing.init(tiny(real_ratio_schedule="bandit", real_ratio_arms=list(ARMS)))
    for arm, episode_return in episodes:
        bandit = mixing.credit(bandit, arm, jnp.float32(episode_return))
    return bandit


def test_members_learn_with_arms_in_the_shares_of_their_probabilities():
    """N = 2, M = 5; X ~ Beta(1, 1) against Beta(c, 1): probabilities 1 / (1 + c) and c / (1 + c)."""
    settings = tiny(n_models=2, n_policies=5, real_ratio_schedule="bandit", real_ratio_arms=[0.1, 0.5])

    def ratios(c):
        return mixing.real_ratios(settings, Hyper.of(settings), _bandit([0.0, c - 1], [0.0, c - 1]), 0).reshape(2, 5)

    low, high = 0.1, 0.5
    np.testing.assert_allclose(ratios(1.01)[0], [low, low, low, high, high])  # half of ten: m first, then n
    np.testing.assert_allclose(ratios(1.01)[1], [low, low, high, high, high])
    np.testing.assert_allclose(ratios(4)[:, 0], low)  # 0.2 of ten
    np.testing.assert_allclose(ratios(4)[:, 1:], high)
    np.testing.assert_allclose(ratios(99), high)  # 0.01: it rests


def test_at_first_all_arms_have_members():
    settings = tiny(n_models=1, n_policies=4, real_ratio_schedule="bandit", real_ratio_arms=list(ARMS))
    bandit = mixing.init(settings)
    np.testing.assert_allclose(mixing.real_ratios(settings, Hyper.of(settings), bandit, 0), ARMS)
    constant = tiny(n_models=1, n_policies=2, real_ratio=0.4)
    np.testing.assert_allclose(mixing.real_ratios(constant, Hyper.of(constant), None, 0), [0.4, 0.4])


def test_nothing_known_is_an_equal_chance():
    np.testing.assert_allclose(mixing.probabilities(_credited()), 0.25, rtol=1e-5)


def test_an_episode_is_credited_to_its_arm_and_older_ones_are_forgotten():
    wins, losses = mixing.beliefs(_credited((1, 60.0), (2, 20.0)))
    second = 1 - 1 / (8 * math.sqrt(2))
    np.testing.assert_allclose(wins, [1, 1 + second, 1, 1], rtol=1e-6)  # 60 is the top of the range, 20 its bottom
    np.testing.assert_allclose(losses, [1, 1, 2, 1], rtol=1e-6)
    wins, losses = mixing.beliefs(_credited((1, 60.0), (2, 20.0), (3, 30.0)))
    third = 1 - 1 / (8 * math.sqrt(3))
    lowest, span = 40 - 20 * third, 40 * third  # of 20 to 60, shrunk around its middle
    gain = (30 - lowest) / span
    np.testing.assert_allclose(wins, [1, 1 + second * third, 1, 1 + gain], rtol=1e-5)
    np.testing.assert_allclose(losses, [1, 1, 1 + third, 2 - gain], rtol=1e-5)


def test_an_outlier_is_forgotten():
    """Arm 0 earns 900, arm 1 600; once something went wrong."""
    episodes = [(i % 2, 900.0 - 300.0 * (i % 2)) for i in range(100)]
    clean, spoilt = (mixing.probabilities(_credited(*episodes[:10], *odd, *episodes[10:])) for odd in ([], [(2, -9e3)]))
    assert clean[0] - clean[1] > 0.5
    assert spoilt[0] - spoilt[1] > 0.4


@pytest.mark.parametrize("value", [0.0, 0.1, -2500.0, 1e6])
def test_before_the_first_success_arms_take_turns(value):
    """All returns are equal: rounding must not tell arms apart that have nothing between them."""
    once = mixing.probabilities(_credited((0, value), (1, value), (1, value)))
    assert once[1] < once[0] < once[2] == pytest.approx(float(once[3]))
    often = mixing.probabilities(_credited(*((i % 4, value) for i in range(80))))
    np.testing.assert_allclose(often, 0.25, atol=0.05)


def test_the_probability_to_be_the_best_in_closed_form():
    """Of X ~ Beta(a, 1) and Y ~ Beta(c, 1), X is the larger with probability a / (a + c)."""
    probs = mixing.probabilities(_bandit([4.0, 1.5], [4.0, 1.5]))
    np.testing.assert_allclose(probs, [5 / 7.5, 2.5 / 7.5], atol=1e-4)


@pytest.mark.parametrize(
    ("gains", "counts"),
    [([0.9, 0.5, 0.7], [1, 1.1, 0.95]), ([140, 138, 136], 200), ([0.2, 0.1, 0.0], 300), ([99.9, 100, 99.5], 100)],
    ids=["few rounds", "many", "nearly all lost", "nearly all won"],
)
def test_the_probability_to_be_the_best_by_quadrature(gains, counts):
    counts = np.broadcast_to(counts, 3)
    laws = [scipy.stats.beta(1 + g, 1 + c - g) for g, c in zip(gains, counts, strict=True)]

    def density(x, arm):
        return laws[arm].pdf(x) * math.prod(law.cdf(x) for i, law in enumerate(laws) if i != arm)

    points = [law.mean() for law in laws]
    exact = [scipy.integrate.quad(density, 0, 1, args=(arm,), points=points, limit=500)[0] for arm in range(3)]
    np.testing.assert_allclose(sum(exact), 1, atol=1e-6)
    np.testing.assert_allclose(mixing.probabilities(_bandit(gains, counts)), exact, atol=2e-4)


def test_the_bandit_follows_the_best_arm_when_it_changes():
    """400 rounds; arm 0 gains 0.9 in the first half and arm 3 in the second, the others 0.1."""

    def round_(bandit: mixing.Bandit, xs):
        best, key = xs
        arm = jax.random.categorical(key, jnp.log(mixing.probabilities(bandit)))
        gain = jnp.where(arm == best, 0.9, 0.1)
        return mixing.credit(bandit, arm, gain), gain

    best = jnp.where(jnp.arange(400) < 200, 0, 3)
    _, gains = jax.lax.scan(
        round_, _bandit(jnp.zeros(4), jnp.zeros(4)), (best, jax.random.split(jax.random.key(0), 400))
    )
    gains = np.asarray(gains)
    assert gains[100:200].mean() > 0.7  # a uniform choice would have 0.3
    assert gains[300:].mean() > 0.7
