"""Measures of models and critics, on worlds whose answers are known by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from tests import probes
from tests.helpers import tiny
from vecpsmbpo import networks, sac
from vecpsmbpo.envs.termination import never
from vecpsmbpo.look import diagnostics, fresh
from vecpsmbpo.types import EnvSpec, Model, Scaling

# ── a linear world: s' = a s + u + noise, r = s' ──────────────────────────────────────────────────────────────────

SPEC = EnvSpec("linear", 1, 1, 1000, never)
NET = networks.GaussianMLP(output_size=2, hidden_size=1, hidden_layers=0)  # affine in its inputs
HORIZON = 8


def _linear_model(a: float, b: float, std: float) -> Model:
    """(Δs, r) ~ N(((a - 1) s + b u, a s + b u), std²)."""
    params = NET.init(jax.random.key(0), jnp.zeros(2))
    # The network clamps log-variances softly: the bias that comes out of it as wanted.
    wanted = 2 * np.log(std)
    raw = networks.MIN_LOG_VARIANCE + np.log(np.expm1(wanted - networks.MIN_LOG_VARIANCE))
    raw = networks.MAX_LOG_VARIANCE - np.log(np.expm1(networks.MAX_LOG_VARIANCE - raw))
    layer = {
        "kernel": jnp.array([[a - 1, a, 0, 0], [b, b, 0, 0]], jnp.float32),
        "bias": jnp.array([0, 0, raw, raw], jnp.float32),
    }
    (name,) = params["params"]
    plain = Scaling(jnp.zeros(2), jnp.ones(2), jnp.ones(2))
    return Model({"params": {name: layer}}, None, plain, jnp.zeros(()), jnp.zeros(()), None)


def _together(*models: Model) -> Model:
    return jax.tree.map(lambda *xs: jnp.stack(xs), *models)


def _windows(a: float, std: float, count: int) -> diagnostics.Windows:
    """What really happens from s_0 = 1 with u = 0."""
    random = np.random.default_rng(0)
    states = [np.ones((count, 1))]
    for _ in range(HORIZON):
        states.append(a * states[-1] + std * random.normal(size=(count, 1)))
    after = np.stack(states[1:], axis=1)
    there = np.ones((count, HORIZON), bool)
    return diagnostics.Windows(states[0], np.zeros((count, HORIZON, 1)), np.concatenate([after, after], -1), there)


def _variance(a: float, std: float) -> np.ndarray:
    """Of s_h, h = 1 to H: std² (a^2h - 1) / (a² - 1)."""
    steps = np.arange(1, HORIZON + 1)
    return std**2 * (a ** (2 * steps) - 1) / (a**2 - 1)


def test_errors_of_a_linear_model_are_those_worked_out_by_hand():
    """E (s_h - b^h s_0)² = (a^h - b^h)² s_0² + Var(s_h), and the model expects its own variance."""
    a, b, std, believed = 0.9, 1.1, 0.2, 0.1
    seen = _windows(a, std, 20_000)
    models = _together(_linear_model(a, 1.0, std), _linear_model(b, 1.0, believed))
    said = diagnostics.imagine(models, seen.obs, seen.action, jax.random.key(1), net=NET, spec=SPEC)
    found = diagnostics.errors(*map(np.asarray, said), seen)
    steps = np.arange(1, HORIZON + 1)
    wrong = np.sqrt((a**steps - b**steps) ** 2 + _variance(a, std))
    np.testing.assert_allclose(found.error[0, :, 0], np.sqrt(_variance(a, std)), rtol=0.02)
    np.testing.assert_allclose(found.error[1, :, 0], wrong, rtol=0.02)
    np.testing.assert_allclose(found.expected[0, :, 0], np.sqrt(_variance(a, std)), rtol=0.02)
    np.testing.assert_allclose(found.expected[1, :, 0], np.sqrt(_variance(b, believed)), rtol=0.02)
    np.testing.assert_allclose(found.no_change[:, 0], np.sqrt((a**steps - 1) ** 2 + _variance(a, std)), rtol=0.02)
    # Two means m and n have the standard deviation |m - n| / √2.
    np.testing.assert_allclose(found.disagreement[:, 0], np.abs(a**steps - b**steps) / np.sqrt(2), rtol=0.02)


def test_rewards_are_of_the_step_and_not_of_the_next_observation():
    """r_h = a s_{h-1} + noise of its own: as uncertain as s_h."""
    seen = _windows(0.9, 0.2, 20_000)
    models = _together(_linear_model(0.9, 1.0, 0.2))
    said = diagnostics.imagine(models, seen.obs, seen.action, jax.random.key(1), net=NET, spec=SPEC)
    found = diagnostics.errors(*map(np.asarray, said), seen)
    np.testing.assert_allclose(found.expected[0, :, 1], np.sqrt(_variance(0.9, 0.2)), rtol=0.02)
    assert np.isnan(found.disagreement).all()  # one model agrees with itself


def test_a_window_counts_as_far_as_its_episode_goes():
    seen = _windows(0.9, 0.2, 4)
    seen.there[1:, 3:] = False
    seen.truth[1:, 3:] = np.nan
    mean, variance = np.zeros((1, 4, HORIZON, 2)), np.zeros((1, 4, HORIZON, 2))
    found = diagnostics.errors(mean, variance, seen)
    np.testing.assert_allclose(found.error[0, 4], np.abs(seen.truth[0, 4]))
    np.testing.assert_allclose(found.error[0, 1], np.sqrt((seen.truth[:, 1] ** 2).mean(axis=0)))


def test_windows_begin_within_the_time_limit_and_hold_what_followed():
    steps = np.arange(12.0)
    obs = np.stack([steps, steps + 100])[..., None]
    there = np.ones((2, 12), bool)
    there[1, 5:] = False
    episodes = fresh.Episodes(obs, obs / 2, steps, obs[..., 0] * 3, obs + 1, ~there, there)
    found = diagnostics.windows(episodes, horizon=4, length=9, random=np.random.default_rng(0))
    order = np.argsort(found.obs[:, 0])
    assert sorted(found.obs[:, 0]) == [*range(9), *range(100, 105)]
    np.testing.assert_array_equal(found.truth[order][3], [[4, 9], [5, 12], [6, 15], [7, 18]])
    np.testing.assert_array_equal(found.action[order][3, :, 0], [1.5, 2, 2.5, 3])
    np.testing.assert_array_equal(found.there[order][12], [True, True, False, False])
    np.testing.assert_array_equal(found.there[order][8], [True] * 4)
    assert found.until(2).truth.shape == (14, 2, 2)


@pytest.mark.parametrize("believed", [1.0, 0.5, 2.0])
def test_calibration_of_a_normal_world(believed):
    """With σ_model = c σ, the central interval of level p holds 2 Φ(c z) - 1 of what happens."""
    seen = _windows(0.9, 0.2, 20_000)
    models = _together(_linear_model(0.9, 1.0, 0.2 * believed))
    ahead = diagnostics.one_step(models, seen.obs, seen.action[:, 0], seen.truth[:, 0], net=NET)
    found = diagnostics.calibration(ahead)
    for index, level in enumerate(diagnostics.LEVELS):
        expected = 2 * norm.cdf(believed * norm.ppf(0.5 + level / 2)) - 1
        np.testing.assert_allclose(found.coverage[0, index], expected, atol=0.01)
    assert found.histogram.mean() == pytest.approx(1)
    edges = norm.ppf(np.linspace(0, 1, diagnostics.BINS + 1)) * believed
    np.testing.assert_allclose(found.histogram[0], np.diff(norm.cdf(edges)) * diagnostics.BINS, atol=0.2)


def test_a_model_that_gives_up_a_hundredth_is_seen_to():
    """Errors of 1 everywhere; 1 is expected of 99 in 100, 20 of the rest: of all intervals only those are too wide."""
    random = np.random.default_rng(0)
    error = random.normal(size=(1, 100_000, 1)) * 3
    expected = np.full_like(error, 3)
    expected[0, ::100] *= 20
    ahead = diagnostics.OneStep(error, expected)
    np.testing.assert_allclose(diagnostics.calibration(ahead).coverage[0, :, 0], diagnostics.LEVELS, atol=0.01)
    found = diagnostics.reliability(ahead, np.array([3.0]))
    np.testing.assert_allclose(found.expected[0], [1] * 12 + [20] * 2, rtol=1e-6)
    np.testing.assert_allclose(found.made[0], np.ones(14), rtol=0.2)


def test_reliability_of_dimensions_that_do_not_vary_or_few_rows():
    ahead = diagnostics.OneStep(np.full((2, 3, 2), 0.5), np.array([0.1, 0.4]) * np.ones((2, 3, 2)))
    found = diagnostics.reliability(ahead, np.array([0.0, 2.0]))
    np.testing.assert_allclose(found.expected, 0.2)
    np.testing.assert_allclose(found.made, 0.25)


# ── critics ───────────────────────────────────────────────────────────────────────────────────────────────────────


def _constant(reward: float, steps: int, ends_at: int | None = None, log_prob: float = 0.0) -> fresh.Episodes:
    """One episode with the same reward at every step."""
    zeros, there = np.zeros((1, steps, 1)), np.ones((1, steps), bool)
    terminated = np.zeros((1, steps), bool)
    if ends_at is not None:
        terminated[0, ends_at], there[0, ends_at + 1 :] = True, False
    rewards = np.where(there, reward, 0.0)
    return fresh.Episodes(zeros, zeros, np.full((1, steps), log_prob) * there, rewards, zeros, terminated, there)


def test_the_return_of_a_constant_reward():
    """1 / (1 - γ) where it goes on for ever, of which γ^T lies beyond T steps; a finite sum where it terminates."""
    discount, steps = 0.9, 60
    found = diagnostics.returns(_constant(1.0, steps), discount, np.zeros(1))[0]
    np.testing.assert_allclose(found, (1 - discount ** np.arange(steps, 0, -1)) / (1 - discount))
    known = diagnostics.known(_constant(1.0, steps), discount)[0]
    assert known.sum() == steps - diagnostics.tail(discount) + 1
    np.testing.assert_allclose(found[known], 10, rtol=diagnostics.TAIL)
    ended = _constant(1.0, steps, ends_at=3)
    np.testing.assert_allclose(diagnostics.returns(ended, discount, np.zeros(1))[0, :5], [3.439, 2.71, 1.9, 1, 0])
    np.testing.assert_array_equal(diagnostics.known(ended, discount)[0], np.arange(steps) <= 3)


def test_the_entropy_of_later_actions_is_earned_as_well():
    """G = r + γ (G - α log π): (r - γ α log π) / (1 - γ)."""
    found = diagnostics.returns(_constant(1.0, 200, log_prob=-2.0), 0.9, np.full(1, 0.5))
    assert found[0, 0] == pytest.approx((1 + 0.9 * 0.5 * 2) / 0.1)


@pytest.mark.parametrize(("discount", "steps"), [(0.99, 459), (0.998, 2301), (0.9, 44), (1.0, 3000), (0.0, 0)])
def test_how_far_a_return_is_looked_at(discount, steps):
    assert diagnostics.tail(discount) == steps


def test_the_smaller_critic_speaks():
    nets = sac.make_networks(tiny(), SPEC)
    agents = [sac.init(jax.random.key(seed), nets, SPEC) for seed in (0, 1)]
    critics = jax.tree.map(lambda *xs: jnp.stack(xs), *(agent.critic for agent in agents))
    obs, action = jax.random.normal(jax.random.key(2), (2, 2, 30, 1))
    found = diagnostics.values(critics, obs, action, nets=nets)
    for index, agent in enumerate(agents):
        expected = np.minimum(*nets.critic.values(agent.critic, obs[index], action[index]))
        np.testing.assert_allclose(found[index], expected, rtol=1e-5)


# ── fresh episodes ────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("terminates", [True, False])
@pytest.mark.parametrize("kind", ["mjx", "host"])
def test_fresh_episodes_of_the_probe(kind, terminates):
    """Observations alternate, 0 1 0 1 …, rewards are 1 - u² at 1, and so is the end where it terminates."""
    world = (
        fresh.MjxWorld(probes.Probe(terminates), 2, seed=0)
        if kind == "mjx"
        else fresh.HostWorld(probes.host(terminates, num_envs=2, seed=0), length=5)
    )
    act = lambda step, obs, key: (np.full((2, 1), 0.5), np.full(2, -0.25))  # noqa: E731
    found = fresh.collect(world, act, 5, jax.random.key(0))
    steps = 2 if terminates else 5
    for episode in range(2):
        np.testing.assert_array_equal(found.there[episode], np.arange(5) < steps)
        np.testing.assert_array_equal(found.obs[episode, :steps, 0], [0, 1, 0, 1, 0][:steps])
        np.testing.assert_array_equal(found.next_obs[episode, :steps, 0], [1, 0, 1, 0, 1][:steps])
        np.testing.assert_array_equal(found.reward[episode], [0, 0.75, 0, 0.75, 0] * found.there[episode])
        np.testing.assert_array_equal(found.log_prob[episode], -0.25 * found.there[episode])
        np.testing.assert_array_equal(np.flatnonzero(found.terminated[episode]), [1] if terminates else [])


def test_no_key_of_a_fresh_world_s_reset_is_one_of_its_actions_keys():
    """`diagnose` draws actions of both with the same seed, and what `split` makes of a key `fold_in` makes, too."""

    class Keyed(probes.Probe):
        def reset(self, rng):
            return super().reset(rng).replace(obs=jax.random.key_data(rng))

    world = fresh.MjxWorld(Keyed(False), 3, seed=5)
    resets = {tuple(row) for _ in range(3) for row in world.reset()}
    steps = jax.vmap(lambda t: jax.random.split(jax.random.fold_in(jax.random.key(5), t), 3))(jnp.arange(50))
    assert len(resets) == 9
    assert not resets & {tuple(row) for row in np.asarray(jax.random.key_data(steps)).reshape(-1, 2)}


def test_a_simulator_that_diverges_ends_an_episode_before_that():
    world = fresh.MjxWorld(probes.FailingProbe(), 8, seed=0)
    found = fresh.collect(world, lambda *_: (np.ones((8, 1)), np.zeros(8)), 9, jax.random.key(0))
    lengths = found.there.sum(axis=1)
    assert len(set(lengths.tolist())) > 1
    assert all((np.abs(column) < 1e10).all() for column in found)
    for there, length in zip(found.there, lengths, strict=True):
        np.testing.assert_array_equal(there, np.arange(9) < length)


# ── states ────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_imagined_states_far_from_real_ones_are_far():
    random = np.random.default_rng(0)
    known, fresh_ones = random.normal(size=(2, 4000, 2)) * [1.0, 100.0]
    found = diagnostics.nearness(known, known[:50] + 3 * np.array([known[:, 0].std(), 0]), fresh_ones)
    assert found.fresh < 0.05
    assert found.imagined > 5 * found.fresh
    assert diagnostics.nearness(known, known[:50], fresh_ones).imagined == 0
