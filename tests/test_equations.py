"""The paper's equations against values worked by hand, or by scipy."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from tests.helpers import new_model, tiny
from vecpsmbpo import dynamics, imagination, networks, posterior, sac
from vecpsmbpo.envs import specs
from vecpsmbpo.types import Hyper, Moments, Posterior, Transition


def test_negative_log_likelihood_is_that_of_a_normal_without_its_constant():
    # Equation 17 by hand: σ² = 4, y - μ = 3: log(4) / 2 + 9 / 8.
    value = dynamics.negative_log_likelihood(jnp.array(1.0), jnp.log(4.0), jnp.array(4.0))
    assert value == pytest.approx(np.log(4) / 2 + 9 / 8)
    mean, log_variance, target = np.random.default_rng(0).normal(size=(3, 100))
    expected = -scipy.stats.norm.logpdf(target, mean, np.exp(log_variance / 2)) - np.log(2 * np.pi) / 2
    np.testing.assert_allclose(
        dynamics.negative_log_likelihood(*map(jnp.asarray, (mean, log_variance, target))), expected, rtol=1e-5
    )


def test_log_variance_is_clamped_softly(key):
    net = networks.GaussianMLP(output_size=1, hidden_size=4, hidden_layers=1)
    params = net.init(key, jnp.zeros(2))
    head = jax.tree.map(jnp.zeros_like, params)

    def log_variance(raw):
        biased = jax.tree.map(lambda x: x, head)
        biased["params"]["Dense_1"]["bias"] = jnp.array([0.0, raw])
        return float(net.apply(biased, jnp.zeros(2))[1][0])

    assert log_variance(1e3) == pytest.approx(2.0, abs=1e-3)
    assert log_variance(-1e3) == pytest.approx(-10.0, abs=1e-3)
    # A.1 by hand at raw = 0: 2 - softplus(2) = -0.126928; -10 + softplus(9.873072) = -0.126877.
    assert log_variance(0.0) == pytest.approx(-0.126877, abs=1e-5)


def test_prediction_adds_the_residual_to_the_state_and_whitens_its_inputs(key):
    """Equations 20 and 21: with zero weights the outputs are the biases, whatever the input."""
    settings, spec = tiny(), specs.get("hopper")
    net = dynamics.network(settings, spec)
    model = jax.jit(partial(dynamics.init, net=net, settings=settings, spec=spec))(key, Hyper.of(settings))
    params = jax.tree.map(jnp.zeros_like, model.params)
    size = spec.obs_size + 1
    bias = jnp.concatenate([jnp.arange(size, dtype=jnp.float32), jnp.full(size, -1e3)])
    params["params"]["Dense_2"]["bias"] = bias
    obs, action = jnp.ones(spec.obs_size), jnp.zeros(spec.action_size)
    next_obs, reward, _ = dynamics.predict(model.replace(params=params), obs, action, key, net=net, spec=spec)
    noise = 5 * np.exp(-5.0)  # five standard deviations at the lower bound of the variance
    np.testing.assert_allclose(next_obs, 1 + np.arange(spec.obs_size), atol=noise)
    assert reward == pytest.approx(spec.obs_size, abs=noise)

    # Whitening: inputs (x - μ) / σ of shifted, scaled data are those of the data before.
    moved = model.scaling._replace(input_mean=jnp.full(size + 2, 3.0), input_std=jnp.full(size + 2, 2.0))
    shifted = model.replace(scaling=moved)
    plain = dynamics.forward(model, obs, action, net=net)
    moved = dynamics.forward(shifted, 3 + 2 * obs, 3 + 2 * action, net=net)
    np.testing.assert_allclose(plain[0], moved[0], atol=1e-6)


def test_predictions_are_drawn_with_the_network_s_variance(key):
    """Equation 21: a raw log-variance of 0 is -0.126877 after A.1's clamp, a deviation of 0.93853."""
    settings, spec = tiny(), specs.get("ball_in_cup")
    model = new_model(key, settings, spec)
    model = model.replace(params=jax.tree.map(jnp.zeros_like, model.params))
    net = dynamics.network(settings, spec)
    obs, action = jnp.full((20_000, spec.obs_size), 5.0), jnp.zeros((20_000, spec.action_size))
    draw = jax.jit(partial(dynamics.predict, net=net, spec=spec))
    next_obs, reward, _ = draw(model, obs, action, key)
    np.testing.assert_allclose(np.mean(next_obs, axis=0), 5.0, atol=0.04)
    np.testing.assert_allclose(np.std(next_obs, axis=0), 0.93853, rtol=0.03)
    assert np.std(reward) == pytest.approx(0.93853, rel=0.03)
    assert abs(np.corrcoef(next_obs[:, 0], reward)[0, 1]) < 0.03  # independently


def test_whitening_uses_the_data_s_mean_and_standard_deviation():
    rows = np.random.default_rng(0).normal(5.0, 3.0, size=(40, 4))  # obs, action, Δs, r
    rows[:, 1] = 7.0  # never varies: left unscaled
    deviation = jnp.asarray(((rows - rows.mean(0)) ** 2).sum(0))
    moments = Moments(jnp.asarray(rows.mean(0)), deviation, jnp.zeros(()), jnp.zeros(()), inputs=2)
    mean, std, outputs = dynamics.scaling(moments, jnp.int32(40), tiny(recipe="paper"))
    np.testing.assert_allclose(mean, rows.mean(0)[:2], rtol=1e-5)
    np.testing.assert_allclose(std, [rows[:, 0].std(), 1.0], rtol=1e-5)
    np.testing.assert_array_equal(outputs, [1, 1])  # A.1: as they are
    _, _, outputs = dynamics.scaling(moments, jnp.int32(40), tiny(whiten_targets=True))
    np.testing.assert_allclose(outputs, rows[:, 2:].std(0), rtol=1e-5)


def test_optimistic_probabilities_by_hand():
    # Equation 19: returns 100, 300, 300, 0 at τ = 100: e^1, e^3, e^3, e^0 over their sum 43.8894.
    earned = Posterior(jnp.array([100.0, 300.0, 300.0, 0.0]), jnp.zeros(4), jnp.zeros(4, int))
    expected = np.exp([1, 3, 3, 0]) / np.exp([1, 3, 3, 0]).sum()
    np.testing.assert_allclose(jax.nn.softmax(posterior.logits(earned, None, 100.0)), expected, rtol=1e-6)


def test_infinite_temperature_is_uniform():
    earned = Posterior(jnp.array([1e6, 0.0, -1e6]), jnp.zeros(3), jnp.zeros(3, int))
    np.testing.assert_array_equal(
        jax.nn.softmax(posterior.logits(earned, None, jnp.inf)), np.full(3, 1 / 3, np.float32)
    )


def test_members_are_drawn_with_the_probabilities_of_equation_19():
    earned = Posterior(jnp.array([10.0, 20.0, 0.0, 15.0]), jnp.zeros(4), jnp.zeros(4, int))
    keys = jax.random.split(jax.random.key(1), 20_000)
    members, probs = jax.vmap(lambda key: posterior.draw(posterior.logits(earned, None, jnp.float32(10.0)), key))(keys)
    counts = np.bincount(members, minlength=4)
    expected = np.asarray(probs[0], np.float64)
    assert scipy.stats.chisquare(counts, expected / expected.sum() * 20_000).pvalue > 1e-3


def test_accumulated_returns_stay_exact_over_thousands_of_episodes():
    returns = np.random.default_rng(0).uniform(2900, 3100, 3000).astype(np.float32)

    def add(earned, value):
        return posterior.credit(earned, jnp.int32(1), value, jnp.bool_(True)), None

    earned, _ = jax.lax.scan(add, posterior.init(3), jnp.asarray(returns))
    exact = returns.astype(np.float64).sum()
    logits = posterior.logits(earned, None, jnp.float32(15_000.0))
    assert float(logits[1] - logits[0]) == pytest.approx(exact / 15_000, rel=1e-6)
    assert earned.returns[0] == 0


def test_only_the_acting_member_is_credited_and_only_when_it_counts():
    earned = posterior.credit(posterior.init(3), jnp.int32(2), jnp.float32(5.0), jnp.bool_(True))
    earned = posterior.credit(earned, jnp.int32(0), jnp.float32(7.0), jnp.bool_(False))
    np.testing.assert_array_equal(earned.returns, [0, 0, 5])


def _after(*episodes):
    """What four members have earned after these episodes: member and return of each."""
    earned = posterior.init(4)
    for member, episode_return in episodes:
        earned = posterior.credit(earned, jnp.int32(member), jnp.float32(episode_return), jnp.bool_(True))
    return earned


@pytest.mark.parametrize(
    ("episodes", "best"),
    [
        ([(0, -50.0), (1, -10.0), (2, -30.0), (1, -12.0)], 1),  # by the sum: member 3, which never acted
        ([(1, 100.0)] * 8 + [(2, 150.0)] * 5, 2),  # by the sum: whoever acted most
        ([(1, 100.0)] * 8 + [(2, 900.0)], 1),  # 9 episodes, 2.25 for each: one is not half as many, ...
        ([(1, 100.0)] * 7 + [(2, 900.0)], 2),  # ... of 8 it is
        ([], 0),
    ],
)
def test_the_best_member_earns_most_per_episode_of_enough(episodes, best):
    assert int(posterior.best(_after(*episodes))) == best


def test_tanh_gaussian_density_against_scipy(key):
    loc, scale = jnp.array([0.3, -1.5, 0.0]), jnp.array([0.5, 0.1, 2.0])
    keys = jax.random.split(key, 200)
    action, log_prob = jax.vmap(networks.TanhGaussian(loc, scale).sample)(keys)
    inner = np.abs(action).max(axis=1) < 0.999  # beyond, arctanh of a float32 says nothing
    action = np.asarray(action, np.float64)[inner]
    # Change of variables a = tanh(u): log p(a) = log N(arctanh a) - Σ log(1 - a²).
    expected = scipy.stats.norm.logpdf(np.arctanh(action), loc, scale).sum(1) - np.log1p(-(action**2)).sum(1)
    assert inner.sum() > 50
    np.testing.assert_allclose(np.asarray(log_prob)[inner], expected, rtol=1e-3, atol=2e-3)


def test_tanh_gaussian_density_is_finite_where_tanh_saturates(key):
    action, log_prob = networks.TanhGaussian(jnp.array([30.0]), jnp.array([0.1])).sample(key)
    assert action[0] == 1.0
    assert np.isfinite(log_prob)


def test_target_value_by_hand():
    # Equations 23, 24, 29: 1 + 0.9 (2 - 0.5 (-3)) = 4.15; terminated: 1.
    arguments = {"next_q": jnp.array(2.0), "next_log_prob": jnp.array(-3.0), "alpha": 0.5, "discount": 0.9}
    assert sac.target_value(jnp.array(1.0), jnp.array(0.0), **arguments) == pytest.approx(4.15)
    assert sac.target_value(jnp.array(1.0), jnp.array(1.0), **arguments) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def agent():
    """A SAC agent for hopper, its networks, and its update as one compiled function."""
    spec, settings = specs.get("hopper"), tiny()
    nets = sac.make_networks(settings, spec)
    update = jax.jit(partial(sac.update, nets=nets))
    return spec, nets, jax.jit(lambda key: sac.init(key, nets, spec))(jax.random.key(0)), update


def test_critic_loss_by_hand(key, agent):
    """Equation 27 with constant networks: Q_1 = Q_2 = 0 against a target of r alone (γ = 0)."""
    spec, nets, agent, _ = agent
    zero = jax.tree.map(jnp.zeros_like, agent.critic)
    batch = _batch(spec, reward=jnp.array([1.0, 3.0]))
    noise = jnp.zeros_like(batch.action)
    loss, q_mean = jax.jit(partial(sac.critic_loss, nets=nets))(zero, agent, batch, jnp.float32(0.0), noise)
    assert loss == pytest.approx(0.5 * (1 + 9) / 2 * 2)  # two critics
    assert q_mean == 0


def _answering(critic, first, second):
    """Parameters of a twin critic whose Q_1 and Q_2 are these constants."""
    critic = jax.tree.map(jnp.zeros_like, critic)
    for name, value in (("first", first), ("second", second)):
        layers = critic["params"][name]
        layers[sorted(layers)[-1]]["bias"] = jnp.array([value])
    return critic


@pytest.mark.parametrize("values", [(2.0, 5.0), (5.0, 2.0)])
def test_losses_take_the_smaller_of_the_two_critics(values, key, agent):
    """Equations 24 to 29 with constant critics, Q = 2 and 5, α = 1/2, γ = 0.9: the actor's loss is E[log π] / 2 - 2,
    the target 1 + 0.9 (2 - log π / 2)."""
    spec, nets, agent, _ = agent
    batch, alpha = _batch(spec, reward=jnp.ones(2)), jnp.float32(0.5)
    noise = jax.random.normal(key, batch.action.shape)
    loss, log_prob = sac.actor_loss(agent.actor, _answering(agent.critic, *values), alpha, batch.obs, noise, nets=nets)
    assert loss == pytest.approx(0.5 * float(log_prob) - 2, abs=1e-5)
    _, log_prob = nets.actor.distribution(agent.actor, batch.next_obs).sample(key)
    target = 1 + 0.9 * (2 - 0.5 * np.asarray(log_prob))
    learner = agent.replace(target_critic=_answering(agent.critic, *values), log_alpha=jnp.log(alpha))
    loss, _ = sac.critic_loss(_answering(agent.critic, 0.0, 1.0), learner, batch, jnp.float32(0.9), noise, nets=nets)
    assert loss == pytest.approx(0.5 * np.mean(target**2 + (1 - target) ** 2), rel=1e-5)


def _updated(update, agent, batch, hyper, key):
    return update(agent, batch, sac.Noise.draw(key, batch.action.shape), hyper)


def test_alpha_moves_towards_the_target_entropy(key, agent):
    spec, _, agent, update = agent
    for target, rises in ((50.0, True), (-50.0, False)):
        hyper = Hyper.of(tiny()).replace(target_entropy=jnp.float32(target))
        after = _updated(update, agent, _batch(spec), hyper, key)
        assert (after.log_alpha > agent.log_alpha) == rises


def test_target_critic_is_a_running_average(key, agent):
    spec, _, agent, update = agent
    after = _updated(update, agent, _batch(spec), Hyper.of(tiny()), key)
    expected = jax.tree.map(lambda old, new: 0.995 * old + 0.005 * new, agent.target_critic, after.critic)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), after.target_critic, expected)


@pytest.mark.parametrize(
    ("task", "corners"),
    [
        # Table 1: hopper 1 → 15 over epochs 20 → 100; by hand at 60: 1 + 40 / 80 · 14 = 8.
        ("hopper", {0: 1, 20: 1, 25: 1, 26: 2, 60: 8, 99: 14, 100: 15, 5000: 15}),
        ("ball_in_cup", {0: 1, 60: 1, 150: 1}),
    ],
)
def test_horizon_schedule(task, corners):
    from vecpsmbpo import config

    settings = config.compose([f"env={task}"])
    for epoch, horizon in corners.items():
        assert imagination.horizon(settings, jnp.int32(1000 * epoch)) == horizon, epoch


def test_the_horizon_grows_from_epoch_to_epoch_and_not_within():
    settings = tiny(horizon_first=1, horizon_last=15, horizon_ramp_start=20, horizon_ramp_end=100)
    assert [int(imagination.horizon(settings, jnp.int32(t))) for t in (25_000, 25_999, 26_000)] == [1, 1, 2]


def test_horizon_schedule_may_fall():
    settings = tiny(horizon_first=9, horizon_last=1, horizon_ramp_start=0, horizon_ramp_end=8)
    for epoch, horizon in {0: 9, 4: 5, 8: 1, 9: 1}.items():
        assert imagination.horizon(settings, jnp.int32(1000 * epoch)) == horizon


def test_longer_rollouts_start_from_fewer_states_and_are_never_cut():
    from vecpsmbpo import config

    settings = config.compose(["env=hopper"])
    batch, capacity = imagination.batch_size(settings), imagination.ring_capacity(settings)
    assert capacity == 10**6
    assert 100_000 % batch == 0
    for horizon in range(1, 16):
        starts = batch * int(imagination.batches_per_refresh(settings, jnp.int32(horizon)))
        assert starts == (100_000 if horizon <= 10 else capacity // (horizon * batch) * batch)
        assert starts * horizon <= capacity


def test_policies_learn_from_the_rows_of_one_epoch_of_refreshes_at_the_horizons_they_had():
    """Four refreshes of 100 starts in an epoch; the horizon grows from 1 to 2 at step 26,000."""
    settings = tiny(
        epoch_steps=1000, model_update_every=250, total_steps=1000, warmup_steps=100, rollout_starts=100,
        horizon_first=1, horizon_last=15, horizon_ramp_start=20, horizon_ramp_end=100,
    )  # fmt: skip
    # Steps that learn after a refresh at 25,000, 25,750, 26,000, 26,000 (the last of its period), 26,250, 26,750.
    steps = {25_250: 400, 26_000: 400, 26_001: 500, 26_250: 500, 26_251: 600, 26_751: 800, 27_000: 800}
    assert {t: int(imagination.retained_rows(settings, jnp.int32(t))) for t in steps} == steps


@pytest.mark.parametrize(
    ("starts", "capacity", "horizon"), [(100_003, 10**6, 1), (100_000, 50_000, 25), (10_000, 7, 7)]
)
def test_batches_are_large_and_the_ring_holds_a_rollout_of_each(starts, capacity, horizon):
    """Also of a prime number of starts, and in a ring that is small for the horizon."""
    settings = tiny(rollout_starts=starts, imagined_capacity=capacity, horizon_last=horizon)
    batch, ring = imagination.batch_size(settings), imagination.ring_capacity(settings)
    batches = int(imagination.batches_per_refresh(settings, jnp.int32(horizon)))
    assert batch * horizon * batches <= ring <= capacity
    assert batch >= min(2000, capacity // horizon // 2)
    assert batch * batches > 0.9 * min(starts, capacity // horizon) - batch


def _batch(spec, reward=None) -> Transition:
    reward = jnp.zeros(2) if reward is None else reward
    obs = jnp.linspace(-1, 1, 2 * spec.obs_size).reshape(2, -1)
    return Transition(obs, jnp.zeros((2, spec.action_size)), reward, obs + 0.1, jnp.zeros(2))
