"""The fit of one model: the split, early stopping, and that it learns."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers import new_model, tiny
from vecpsmbpo import dynamics, replay
from vecpsmbpo.types import EnvSpec, Hyper, Moments, Scaling, Transition

SPEC = EnvSpec("linear", obs_size=2, action_size=1, episode_length=10, terminated=lambda o, a, n: n[..., 0] > 9)
CAPACITY = 2048


@pytest.fixture(scope="module")
def linear():
    """Rows of Δs = (0.5 a, -0.2 s_0) with noise 0.1, r = s_1: and the settings to fit them."""
    settings = tiny(
        recipe="paper",
        model_hidden_size=32,
        model_batch_size=64,
        model_max_epochs=200,
        model_learning_rate=3e-3,
        model_patience=30,
    )
    keys = jax.random.split(jax.random.key(0), 3)
    obs, action = jax.random.normal(keys[0], (CAPACITY, 2)), jax.random.normal(keys[1], (CAPACITY, 1))
    delta = jnp.stack([0.5 * action[:, 0], -0.2 * obs[:, 0]], axis=1)
    next_obs = obs + delta + 0.1 * jax.random.normal(keys[2], (CAPACITY, 2))
    rows = replay.pack(Transition(obs, action, obs[:, 1], next_obs, jnp.zeros(CAPACITY)))
    return settings, rows


def _moments(rows):
    values = jnp.concatenate([rows[:, :3], rows[:, 3:5] - rows[:, :2], rows[:, 5:6]], axis=1)
    deviation = ((values - values.mean(0)) ** 2).sum(0)
    return Moments(values.mean(0), deviation, jnp.min(rows[:, 5]), jnp.max(rows[:, 5]), inputs=3)


@pytest.fixture(scope="module")
def fit(linear):
    """The fit as one compiled function of (model, number of rows, key), and of other rows."""
    return _compiled_fit(*linear)


def _compiled_fit(settings, usual):
    usual_hyper = Hyper.of(settings)

    @jax.jit
    def run(model, count, key, rows=usual, hyper=usual_hyper):
        split = dynamics.Split.draw(key, count, CAPACITY, settings.validation_block)
        whitening = dynamics.scaling(_moments(rows), jnp.int32(CAPACITY), settings)
        net = dynamics.network(settings, SPEC)
        return dynamics.fit(model, rows, split, whitening, hyper, key, net=net, settings=settings, spec=SPEC)

    return run


def test_fit_learns_the_mean_and_the_noise(linear, fit, key):
    settings, _ = linear
    model = new_model(key, settings, SPEC)
    fitted = fit(model, jnp.int32(CAPACITY), key)
    obs, action = jnp.array([[0.5, -0.5]]), jnp.array([[1.0]])
    mean, log_variance, _ = dynamics.forward(fitted, obs, action, net=dynamics.network(settings, SPEC))
    np.testing.assert_allclose(mean[0], [0.5, -0.1, -0.5], atol=0.05)
    np.testing.assert_allclose(np.exp(log_variance[0, :2] / 2), 0.1, rtol=0.3)
    # The best that any model can do is the noise's variance on two of three outputs: 0.01 · 2 / 3.
    assert fitted.val_mse == pytest.approx(0.01 * 2 / 3, rel=0.2)


def test_a_data_set_that_grows_needs_no_new_program(linear, fit, key):
    settings, _ = linear
    model = new_model(key, settings, SPEC)
    for rows in (5, 64, 777, CAPACITY):
        model = fit(model, jnp.int32(rows), key)
    assert fit._cache_size() == 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(model))


def test_the_best_epoch_is_kept(linear, key):
    """At a learning rate that throws the error up and down, more epochs never give a worse model back, and the error
    that a fit reports is that of the parameters it hands back."""
    settings, rows = linear
    hyper = Hyper.of(settings).replace(model_learning_rate=jnp.float32(0.1))
    model = new_model(key, settings, SPEC, hyper)
    split = dynamics.Split.draw(key, jnp.int32(CAPACITY), CAPACITY, settings.validation_block)
    validation, exists = split.validation_rows(jnp.int32(0), CAPACITY, settings.validation_block)
    held_out = rows[validation[exists]]
    target = jnp.concatenate([held_out[:, 3:5] - held_out[:, :2], held_out[:, 5:6]], axis=1)
    errors = []
    for epochs in (1, 4, 16):
        chosen = dataclasses.replace(settings, model_max_epochs=epochs)
        fitted = _compiled_fit(chosen, rows)(model, jnp.int32(CAPACITY), key, hyper=hyper)
        net = dynamics.network(settings, SPEC)
        mean = dynamics.forward(fitted, held_out[:, :2], held_out[:, 2:3], net=net).mean
        assert fitted.val_mse == pytest.approx(float(jnp.mean((mean - target) ** 2)), rel=1e-4)
        errors.append(float(fitted.val_mse))
    assert errors == sorted(errors, reverse=True)


def test_a_fit_stops_after_its_patience(linear, fit, key):
    """With a learning rate of 0 the first epoch's error is never improved on."""
    settings, _ = linear
    hyper = Hyper.of(settings).replace(model_learning_rate=jnp.float32(0.0))
    model = new_model(key, settings, SPEC, hyper)
    after = fit(model, jnp.int32(CAPACITY), key, hyper=hyper)
    jax.tree.map(np.testing.assert_array_equal, after.params, model.params)
    steps = jax.tree.leaves(after.optimizer)[0] - jax.tree.leaves(model.optimizer)[0]
    per_epoch = -(-CAPACITY // 5 * 4 // settings.model_batch_size)
    assert steps == pytest.approx((1 + settings.model_patience) * per_epoch, abs=1 + settings.model_patience)


def test_what_cannot_be_predicted_does_not_keep_the_rest_from_being_learned(linear, fit, key):
    """Impacts at random moments make up nearly all of the error. The other coordinate's rule, new, is less than
    the threshold's 1% of it, and is learned all the same."""
    settings, rows = linear
    model = fit(new_model(key, settings, SPEC), jnp.int32(CAPACITY), key)
    impact = 10.0 * jax.random.bernoulli(key, 0.1, (CAPACITY,))
    new_rule = rows.at[:, 3].add(impact).at[:, 4].set(rows[:, 1] + 0.2 * rows[:, 0])
    after = fit(model, jnp.int32(CAPACITY), key, new_rule)
    mean = dynamics.forward(after, rows[:, :2], rows[:, 2:3], net=dynamics.network(settings, SPEC)).mean
    assert after.val_mse > 100 * np.mean((0.4 * rows[:, 0]) ** 2) / 3 / 2  # of what the old rule is wrong by
    assert np.mean((mean[:, 1] - 0.2 * rows[:, 0]) ** 2) < 0.01 * np.mean((0.4 * rows[:, 0]) ** 2)


def test_split_is_a_partition_with_one_row_in_five_validating(key):
    rows, block = 1003, 5
    split = dynamics.Split.draw(key, jnp.int32(rows), CAPACITY, block)
    validation, exists = split.validation_rows(jnp.int32(0), 512, block)
    validation = np.asarray(validation)[np.asarray(exists)]
    train = np.unique(split.train_rows(key, 40_000, block))
    assert len(validation) == len(np.unique(validation)) == 200
    assert not set(validation) & set(train.tolist())
    assert set(validation) | set(train.tolist()) == set(range(1000))
    again, _ = dynamics.Split.draw(jax.random.key(1), jnp.int32(rows), CAPACITY, block).validation_rows(0, 200, block)
    assert set(validation) != set(np.asarray(again).tolist())


def test_training_rows_are_uniform(key):
    import scipy.stats

    split = dynamics.Split.draw(key, jnp.int32(50), CAPACITY, 5)
    counts = np.bincount(split.train_rows(key, 40_000, 5), minlength=50)
    assert scipy.stats.chisquare(counts[counts > 0]).pvalue > 1e-3


def test_where_the_rule_is_not_known_termination_is_learned(linear, key):
    """Rows that terminate where s_0 > 0.5: the learned probability says so, and predictions are drawn with it."""
    settings, rows = linear
    spec = dataclasses.replace(SPEC, terminated=None)
    rows = rows.at[:, -1].set(rows[:, 0] > 0.5)
    net = dynamics.network(settings, spec)

    @jax.jit
    def run(key):
        split = dynamics.Split.draw(key, jnp.int32(CAPACITY), CAPACITY, settings.validation_block)
        whitening = Scaling(jnp.zeros(3), jnp.ones(3), jnp.ones(3))
        model = new_model(key, settings, spec)
        hyper = Hyper.of(settings)
        net = dynamics.network(settings, spec)
        return dynamics.fit(model, rows, split, whitening, hyper, key, net=net, settings=settings, spec=spec)

    fitted = run(key)
    obs = jnp.array([[-1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [2.0, -1.0]])
    logit = dynamics.forward(fitted, obs, jnp.zeros((4, 1)), net=net).logit
    np.testing.assert_array_less(jax.nn.sigmoid(logit[:2]), 0.05)
    np.testing.assert_array_less(0.95, jax.nn.sigmoid(logit[2:]))
    # On the border predictions are drawn, with the learned probability.
    border, action = jnp.full((4000, 2), jnp.array([0.5, 0.0])), jnp.zeros((4000, 1))
    drawn = dynamics.predict(fitted, border, action, key, net=net, spec=spec).terminated
    chance = float(jax.nn.sigmoid(dynamics.forward(fitted, border[0], action[0], net=net).logit))
    assert 0.02 < chance < 0.98
    assert float(drawn.mean()) == pytest.approx(chance, abs=4 * np.sqrt(chance * (1 - chance) / 4000))


def test_whitened_targets_resolve_changes_that_the_variance_floor_hides(linear, key):
    """Changes a thousand times smaller than the rows': predicted raw they lie below the floor's deviation of 0.0067
    and are fitted poorly; in units of their deviation nothing is lost."""
    settings, rows = linear
    small = rows.at[:, 3:5].set(rows[:, :2] + 1e-3 * (rows[:, 3:5] - rows[:, :2]))
    explained = {}
    for whiten in (False, True):
        chosen = dataclasses.replace(settings, whiten_targets=whiten, model_patience=5)
        fitted = _compiled_fit(chosen, small)(new_model(key, chosen, SPEC), jnp.int32(CAPACITY), key)
        obs, action = small[:, :2], small[:, 2:3]
        prediction = dynamics.forward(fitted, obs, action, net=dynamics.network(chosen, SPEC))
        truth = 1e-3 * jnp.stack([0.5 * action[:, 0], -0.2 * obs[:, 0]], axis=1)
        error = jnp.mean((prediction.mean[:, :2] - truth) ** 2, axis=0)
        explained[whiten] = 1 - np.asarray(error / jnp.var(truth, axis=0))
        if whiten:
            np.testing.assert_allclose(np.exp(prediction.log_variance[:, :2].mean(0) / 2), 1e-4, rtol=0.6)
    assert explained[True].min() > 0.95
    assert explained[False].max() < 0.9


def test_a_rare_reward_is_given_up_by_the_likelihood_and_learned_with_beta(key):
    """One row in 35 has the reward 1, others none: by equation 17 a model is sure of the 0 and gives the others a large
    variance, which takes their weight away."""
    obs_key, action_key = jax.random.split(key)
    obs, action = jax.random.normal(obs_key, (CAPACITY, 2)), jax.random.normal(action_key, (CAPACITY, 1))
    rewarded = jnp.sum(obs**2, axis=1) < 0.05
    delta = jnp.stack([0.5 * action[:, 0], -0.2 * obs[:, 0]], axis=1)
    rows = replay.pack(Transition(obs, action, rewarded.astype(jnp.float32), obs + delta, jnp.zeros(CAPACITY)))
    expected = {}
    for beta in (0.0, 1.0):
        settings = tiny(
            recipe="stable", nll_beta=beta / 2, reward_nll_beta=beta, model_hidden_size=32, model_batch_size=64,
            model_max_epochs=100, model_learning_rate=3e-3, model_patience=30,
        )  # fmt: skip
        fitted = _compiled_fit(settings, rows)(new_model(key, settings, SPEC), jnp.int32(CAPACITY), key)
        prediction = dynamics.forward(fitted, obs, action, net=dynamics.network(settings, SPEC))
        expected[beta] = [float(prediction.mean[which, 2].mean()) for which in (rewarded, ~rewarded)]
    assert expected[0.0][0] < 0.2
    assert expected[1.0][0] > 0.5
    assert abs(expected[1.0][1]) < 0.05
