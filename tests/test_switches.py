"""The paper's ablations: every switch changes what it should and nothing else."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from tests import probes
from tests.helpers import algorithm, tiny
from tests.test_drivers import make_driver, settings_for
from tests.test_imagination import constant
from vecpsmbpo import dynamics, metrics, mixture, posterior
from vecpsmbpo.envs import specs
from vecpsmbpo.train import initial_inputs
from vecpsmbpo.types import Bandit, Counters, Hyper

# ── forced exploration (equation 33) ─────────────────────────────────────────────────────────────────────────────


def test_forced_exploration_by_hand():
    episodes = jnp.array([1, 4, 5, 10, 100])
    np.testing.assert_allclose(posterior.exploration_probability(5.0, episodes), [1, 1, 1, 0.5, 0.05], rtol=1e-6)
    np.testing.assert_array_equal(posterior.exploration_probability(0.0, episodes), np.zeros(5))


# ── random function prior (equation 34) ──────────────────────────────────────────────────────────────────────────


def test_the_prior_is_added_to_the_network_and_never_fitted(key):
    settings, spec = tiny(prior_scale=0.3), specs.get("hopper")
    hyper = Hyper.of(settings)
    model = dynamics.init(key, hyper, settings, spec)
    plain = dynamics.init(key, hyper, tiny(), spec)
    jax.tree.map(np.testing.assert_array_equal, model.params, plain.params)  # nothing else is drawn differently
    assert plain.prior is None
    net = dynamics.network(settings, spec)
    size = spec.obs_size + 1
    # f_θ answers 1 and 0.5, f_θ0 answers 2 and 3: means 1 + 0.3 · 2, raw log-variances 0.5 + 0.3 · 3.
    ours = constant(model.params, jnp.concatenate([jnp.full(size, 1.0), jnp.full(size, 0.5)]))
    prior = constant(model.prior.params, jnp.concatenate([jnp.full(size, 2.0), jnp.full(size, 3.0)]))
    model = model.replace(params=ours, prior=model.prior.replace(params=prior))
    prediction = dynamics.forward(model, jnp.zeros(spec.obs_size), jnp.zeros(spec.action_size), net=net)
    np.testing.assert_allclose(prediction.mean, 1.6, rtol=1e-6)
    softly = 2 - np.log1p(np.exp(2 - 1.4))  # the soft clamp of A.1
    softly = -10 + np.log1p(np.exp(softly + 10))
    np.testing.assert_allclose(prediction.log_variance, softly, rtol=1e-5)


# ── λ (figure 13 and B.3) ────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize("mean", [0.05, 0.3, 0.5, 0.8])
def test_the_linear_schedule_has_the_constant_s_area(mean):
    progress = jnp.linspace(0, 1, 100_001)
    ratio = np.asarray(mixture.linear(jnp.float32(mean), progress))
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
    ratios = jax.vmap(lambda t: mixture.real_ratio(settings, hyper, None, t))(steps)
    assert float(ratios.mean()) == pytest.approx(mean, abs=1e-3)
    assert float(ratios[0]) == 1


@pytest.mark.parametrize("mean", [0.0, 1.0])
def test_the_linear_schedule_of_no_or_only_real_data_is_constant(mean):
    np.testing.assert_allclose(mixture.linear(jnp.float32(mean), jnp.array([0.01, 0.5, 0.99])), mean)


def _bandit(settings, **changes):
    return mixture.init(settings, jax.random.key(0)).replace(**changes)


def test_exp3s_by_hand():
    """K = 4 arms, T = 200 rounds, weights 1, arm 2 gains 0.75."""
    settings = dataclasses.replace(tiny(), total_steps=8040, real_ratio_arms=(0.0, 0.1, 0.3, 0.5))  # 40 are warm-up
    explored = math.sqrt(4 * (2 * math.log(800) + math.e) / ((math.e - 1) * 200))
    assert mixture.rates(settings) == (pytest.approx(explored), 0.005)
    grown = np.ones(4)
    grown[2] = math.exp(explored * (0.75 / 0.25) / 4)
    weights = grown + math.e * 0.005 / 4 * 4
    bandit = _bandit(settings, arm=jnp.int32(2))
    learned = mixture.reinforce(bandit, settings, jnp.float32(0.75))
    np.testing.assert_allclose(np.exp(learned), weights / weights.max(), rtol=1e-5)
    probs = mixture.probabilities(bandit.replace(log_weights=learned), settings)
    np.testing.assert_allclose(probs, (1 - explored) * weights / weights.sum() + explored / 4, rtol=1e-5)


def test_short_runs_do_not_only_explore():
    settings = dataclasses.replace(tiny(), total_steps=400, real_ratio_arms=(0.0, 0.1, 0.3, 0.5))
    bandit = _bandit(settings, log_weights=jnp.array([0.0, -20.0, -20.0, -20.0]))
    np.testing.assert_allclose(mixture.probabilities(bandit, settings), [0.625, 0.125, 0.125, 0.125], atol=1e-6)


def test_an_arm_gains_by_improving_the_return():
    settings = dataclasses.replace(tiny(), total_steps=4000)
    first = _bandit(settings, arm=jnp.int32(1))
    for episode_return in (0.0, 50.0):  # nothing to compare with yet, and no scale
        first = mixture.end_round(first, settings, jnp.float32(episode_return), jax.random.key(1))
        np.testing.assert_array_equal(first.log_weights, 0)
    for episode_return, sign in ((80.0, 1), (20.0, -1)):
        second = mixture.end_round(
            first.replace(arm=jnp.int32(3)), settings, jnp.float32(episode_return), jax.random.key(2)
        )
        neutral = mixture.reinforce(first.replace(arm=jnp.int32(3)), settings, jnp.float32(0.5))
        lead = second.log_weights[3] - second.log_weights[0]
        assert np.sign(lead - (neutral[3] - neutral[0])) == sign


def test_the_bandit_follows_the_best_arm_when_it_changes():
    """2,000 rounds; arm 0 gains 0.9 in the first half and arm 3 in the second, the others 0.1."""
    settings = dataclasses.replace(tiny(), total_steps=2000 * 40, real_ratio_arms=(0.0, 0.1, 0.3, 0.5))

    def round_(bandit: Bandit, xs):
        best, key = xs
        probs = mixture.probabilities(bandit, settings)
        arm = jax.random.categorical(key, jnp.log(probs))
        gain = jnp.where(arm == best, 0.9, 0.1)
        bandit = bandit.replace(arm=arm)
        return bandit.replace(log_weights=mixture.reinforce(bandit, settings, gain)), gain

    best = jnp.where(jnp.arange(2000) < 1000, 0, 3)
    _, gains = jax.lax.scan(round_, _bandit(settings), (best, jax.random.split(jax.random.key(0), 2000)))
    gains = np.asarray(gains)
    assert gains[500:1000].mean() > 0.6  # a uniform choice would have 0.3
    assert gains[1500:].mean() > 0.6


# ── all of them in a run ─────────────────────────────────────────────────────────────────────────────────────────


def run(kind="scan", **changes):
    settings = settings_for(updates_per_step=1, epoch_steps=120, **changes)
    driver = make_driver(kind, True, settings)
    state, lines, epochs = driver.init(*initial_inputs(settings)), [], []
    for epoch in range(settings.total_steps // settings.epoch_steps):
        state, news = driver.run(state, settings.epoch_steps // settings.stride)
        lines += metrics.episode_lines(news, epoch * settings.epoch_steps, settings)
        epochs += metrics.epoch_lines(state, settings)
    return settings, driver, state, lines, epochs


@pytest.fixture(scope="module")
def plain():
    """The final state of the run in which nothing is switched on."""
    return run(real_ratio=0.4)[2]


@pytest.fixture(scope="module")
def averaged():
    """Everything switched on, for the two values of τ in one program."""
    return run(
        posterior="average",
        prior_scale=0.3,
        real_ratio_schedule="bandit",
        **{"sweep.forced_exploration": [0.0, 60.0]},
    )


def test_with_the_average_no_member_acts_or_is_credited(averaged):
    settings, _, state, lines, _ = averaged
    assert {(line["model"], line["policy"]) for line in lines} == {(None, None)}
    np.testing.assert_allclose([line["probs"] for line in lines], 1 / settings.n_members, rtol=1e-6)
    np.testing.assert_array_equal(state.seeds.posterior.returns, 0)


def test_swept_values_run_side_by_side(averaged):
    """Of 240 episodes after the warm-up, none is random at τ = 0; at 60 those with probability min(1, 60 / k)."""
    settings, _, state, lines, epochs = averaged
    assert [lane["forced_exploration"] for lane in settings.lanes] == [0.0, 60.0]
    np.testing.assert_array_equal(state.seeds.hyper.forced_exploration, [0.0, 60.0])
    assert [(line["seed"], line["forced_exploration"]) for line in epochs[:2]] == [(0, 0.0), (0, 60.0)]
    late = {
        value: [line for line in lines if line["forced_exploration"] == value and line["env_steps"] > 122]
        for value in (0.0, 60.0)
    }
    assert not any(line["random"] for line in late[0.0])
    chances = np.array([min(1, 60 / line["episode"]) for line in late[60.0]])
    count = sum(line["random"] for line in late[60.0])
    assert abs(count - chances.sum()) < 4 * np.sqrt((chances * (1 - chances)).sum())


def test_the_bandit_s_choices_are_logged(averaged):
    settings, _, _, _, epochs = averaged
    chosen = [line["real_ratio"] for line in epochs]
    assert set(np.round(chosen, 6)) <= set(settings.real_ratio_arms)
    assert len(set(chosen)) > 1
    np.testing.assert_allclose([sum(line["real_ratio_probs"]) for line in epochs], 1, rtol=1e-5)
    assert len(epochs[0]["real_ratio_probs"]) == len(settings.real_ratio_arms)


def test_priors_stay_as_they_were_drawn(averaged):
    settings, driver, state, _, _ = averaged
    fresh = driver.init(*initial_inputs(settings)).seeds.models
    jax.tree.map(np.testing.assert_array_equal, state.seeds.models.prior, fresh.prior)
    moved = jax.tree.map(lambda a, b: not np.array_equal(a, b), state.seeds.models.params, fresh.params)
    assert all(jax.tree.leaves(moved))


def test_the_average_s_actions_come_from_all_members(key):
    """Policies that always act tanh(i / 4): over many draws each is seen as often as the others."""
    settings = tiny(posterior="average", devices=1)
    learner = algorithm(settings, probes.spec(True))
    inner = {"ReluMLP_0": constant({"params": _actor(learner, key)["ReluMLP_0"]}, jnp.array([0.0, -1e3]))["params"]}
    actors = jax.tree.map(lambda x: jnp.broadcast_to(x, (4, *x.shape)), {"params": inner})
    last = sorted(actors["params"]["ReluMLP_0"])[-1]
    actors["params"]["ReluMLP_0"][last]["bias"] = jnp.stack([jnp.array([i / 4, -1e3]) for i in range(4)])

    def act(counters, key):
        state = learner.init(jax.random.key(0), Hyper.of(settings))
        state = state.replace(
            agents=state.agents.replace(actor=actors), episode=state.episode.replace(random=jnp.bool_(False))
        )
        keys = jax.random.split(key, 4000)
        return jax.vmap(lambda key: learner.act(counters, state, jnp.zeros(1), key)[0])(keys)

    shared = learner.layout.specs().counters
    actions = learner.layout.spread(act, (shared, shared), shared)(Counters(jnp.int32(0), jnp.int32(0)), key)
    which = np.rint(np.arctanh(np.asarray(actions)[:, 0]) * 4).astype(int)
    assert scipy.stats.chisquare(np.bincount(which, minlength=4)).pvalue > 1e-3


def _actor(learner, key):
    from vecpsmbpo import sac

    return sac.init(key, sac.make_networks(learner.settings, learner.spec), learner.spec).actor["params"]


def test_a_swept_value_is_what_it_is_alone():
    """Two temperatures side by side; each lane equals the run with that temperature."""
    _, _, together, lines, _ = run(**{"sweep.temperature": [1.0, 1000.0]})
    _, _, alone, single, _ = run(temperature=1000.0)
    second = [line for line in lines if line["temperature"] == 1000.0]
    for ours, theirs in zip(second, single, strict=True):
        np.testing.assert_allclose(ours["probs"], theirs["probs"], atol=2e-3)
        assert (ours["episode"], ours["seed"], ours["random"]) == (theirs["episode"], theirs["seed"], theirs["random"])
    warm_up = 120
    np.testing.assert_array_equal(together.seeds.real[1, :warm_up], alone.seeds.real[0, :warm_up])
    sharp = [max(line["probs"][0] + line["probs"][1]) for line in lines if line["temperature"] == 1.0]
    assert max(sharp) > 0.9


def test_nothing_changes_where_nothing_is_switched_on(plain):
    """A switch that is off draws no random number: τ_f so small that no episode is random changes no bit."""
    _, _, barely, _, _ = run(real_ratio=0.4, forced_exploration=1e-9)
    jax.tree.map(np.testing.assert_array_equal, plain.seeds.agents.actor, barely.seeds.agents.actor)


@pytest.mark.parametrize(
    "switched",
    [{"real_ratio_schedule": "bandit", "real_ratio_arms": [0.4]}, {"sweep.prior_scale": [0.0]}],
    ids=["a bandit of one arm", "a prior of no weight"],
)
def test_a_switch_that_makes_no_difference_changes_no_number(switched, plain):
    _, _, other, _, _ = run(real_ratio=0.4, **switched)
    np.testing.assert_array_equal(plain.seeds.real, other.seeds.real)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), plain.seeds.agents.actor, other.seeds.agents.actor
    )


def test_averaging_changes_nothing_before_policies_act(plain, averaged):
    """The warm-up of the lane without forced exploration."""
    warm_up, real = 120, averaged[2].seeds.real
    np.testing.assert_array_equal(plain.seeds.real[0, :warm_up], real[0, :warm_up])
    assert (plain.seeds.real[0, warm_up:240, 1] != real[0, warm_up:240, 1]).any()
