"""PETS: the optimizer on functions whose maximum is known, trajectory sampling against enumeration, and whole runs."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import helpers
from tests.helpers import constant, new_model, tiny
from tests.learners import make_driver
from vecpsmbpo import dynamics, metrics
from vecpsmbpo.algorithms.pets import planning
from vecpsmbpo.programs import evaluation_keys, initial_inputs
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec

LIMIT = 3.5
SPEC = EnvSpec("counter", obs_size=1, action_size=1, episode_length=10, terminated=lambda o, a, n: n[..., 0] > LIMIT)


@pytest.mark.parametrize("best", [0.3, -0.8, 1.0])
def test_cross_entropy_finds_the_maximum_of_a_quadratic(best, key):
    """A sum of parabolas, each with its own width, whose maximum may lie on the border."""
    settings = tiny(algo="pets", plan_population=1000, plan_elites=100, plan_iterations=15)
    widths = jnp.array([[1.0, 4.0], [9.0, 1.0], [0.5, 2.0]])

    def value(plans, key):
        return -jnp.sum(widths * (plans - best) ** 2, axis=(1, 2))

    found = planning.cross_entropy(value, jnp.zeros((3, 2)), key, settings)
    np.testing.assert_allclose(found, best, atol=0.15 if best == 1.0 else 0.05)  # a border is approached by halves


def test_cross_entropy_begins_where_it_is_told(key):
    """Of two equal peaks, the one near the start is found: a plan goes on instead of beginning anew."""
    settings = tiny(algo="pets", plan_population=100, plan_elites=10, plan_iterations=8)

    def value(plans, key):
        return jnp.sum(jnp.exp(-20 * (jnp.abs(plans) - 0.7) ** 2), axis=(1, 2))

    for start in (-0.5, 0.5):
        found = planning.cross_entropy(value, jnp.full((2, 1), start), key, settings)
        np.testing.assert_allclose(found, np.sign(start) * 0.7, atol=0.05)


def test_a_plan_in_which_a_model_diverges_is_worth_nothing(key):
    settings = tiny(algo="pets", plan_population=100, plan_elites=10, plan_iterations=8)

    def value(plans, key):
        best = -jnp.sum((plans - 0.5) ** 2, axis=(1, 2))
        return jnp.where(plans[:, 0, 0] < 0, jnp.nan, jnp.where(plans[:, 1, 0] < 0, 1e20, best))

    found = planning.cross_entropy(value, jnp.zeros((2, 1)), key, settings)
    np.testing.assert_allclose(found, 0.5, atol=0.05)


def _counters(settings):
    """Two models: model n adds 2 n + 1 to the state, and pays 10 n + 1."""
    models = [new_model(jax.random.key(0), settings, SPEC)] * 2
    answers = [jnp.array([2.0 * n + 1, 10.0 * n + 1, -1e3, -1e3]) for n in range(2)]
    models = [
        model.replace(params=constant(model.params, answer)) for model, answer in zip(models, answers, strict=True)
    ]
    return jax.tree.map(lambda *xs: jnp.stack(xs), *models)


def _by_enumeration(sequences):
    """The mean return over sequences of models, ended where the state passes the limit."""
    returns = []
    for sequence in sequences:
        state = total = 0.0
        for n in sequence:
            if state > LIMIT:
                break
            state, total = state + 2 * n + 1, total + 10 * n + 1
        returns.append(total)
    return np.mean(returns)


@pytest.mark.parametrize(
    ("kept", "sequences"),
    [("own", [(0,) * 4, (1,) * 4]), ("any", list(itertools.product((0, 1), repeat=4)))],
    ids=["TS-infinity", "TS1"],
)
def test_trajectory_sampling_against_enumeration(kept, sequences, key):
    """TS∞: every particle in one model. TS1: every sequence of models is equally likely."""
    settings = tiny(algo="pets", n_models=2, plan_particles=4, plan_horizon=2, plan_hold=2, rollout_models=kept)
    models, plans, net = _counters(settings), jnp.zeros((3000, 2, 1)), dynamics.network(settings, SPEC)
    returns = planning.expected_returns(models, jnp.zeros(1), plans, key, net=net, settings=settings, spec=SPEC)
    noise = float(4 * np.std(returns) / np.sqrt(len(returns)) + 0.05)  # the models' own noise is tiny
    assert float(returns.mean()) == pytest.approx(_by_enumeration(sequences), abs=noise)


def test_the_two_ways_of_sampling_differ():
    assert _by_enumeration([(0,) * 4, (1,) * 4]) != _by_enumeration(list(itertools.product((0, 1), repeat=4)))


def test_each_action_is_held_and_reaches_the_model(key):
    """A model that moves the state by the action: a plan (a, b) held for 3 steps each moves it by 3 a + 3 b."""
    settings = tiny(algo="pets", plan_particles=2, plan_horizon=2, plan_hold=3, model_hidden_layers=1)
    model = new_model(key, settings, SPEC)
    params = jax.tree.map(jnp.zeros_like, model.params)["params"]
    # swish(x) ≈ x for large x: hidden unit 0 carries 100 + a, and the outputs take 100 away. The reward is the state.
    params["Dense_0"]["kernel"] = params["Dense_0"]["kernel"].at[1, 0].set(1.0).at[0, 1].set(1.0)
    params["Dense_0"]["bias"] = params["Dense_0"]["bias"].at[:2].set(100.0)
    params["Dense_1"]["kernel"] = params["Dense_1"]["kernel"].at[0, 0].set(1.0).at[1, 1].set(1.0)
    params["Dense_1"]["bias"] = jnp.array([-100.0, -100.0, -1e3, -1e3])
    models = jax.tree.map(lambda x: jnp.stack([x, x]), model.replace(params={"params": params}))
    plans = jnp.array([[[0.5], [-0.2]], [[0.0], [0.0]]])
    net = dynamics.network(settings, SPEC)
    returns = planning.expected_returns(models, jnp.zeros(1), plans, key, net=net, settings=settings, spec=SPEC)
    states = np.cumsum([0, 0.5, 0.5, 0.5, -0.2, -0.2])  # before each of the six steps
    np.testing.assert_allclose(returns, [states.sum(), 0.0], atol=0.15)


def test_a_plan_goes_on_from_the_one_before(monkeypatch):
    """The next search begins at the former plan, one action later; without a plan due, the former one is kept."""
    settings = tiny(algo="pets", devices=1)
    learner = helpers.algorithm(settings, SPEC)
    starts = []

    def search(value, mean, key, settings):
        starts.append(mean)
        return mean + 10

    monkeypatch.setattr(planning, "cross_entropy", search)
    plan = jnp.arange(3.0)[:, None]
    with jax.disable_jit():
        action, following = learner._follow(jnp.bool_(True), None, plan, jnp.zeros(1), jax.random.key(0))
        kept = learner._follow(jnp.bool_(False), None, plan, jnp.zeros(1), jax.random.key(0))
    np.testing.assert_array_equal(starts[0][:, 0], [1, 2, 0])
    np.testing.assert_array_equal(following[:, 0], [11, 12, 10])
    assert action[0] == 11
    np.testing.assert_array_equal(kept[1], plan)


@pytest.mark.parametrize("kind", ["scan", "host"])
def test_a_run_plans_well(kind):
    """On the probe (reward 1 - a² at every other step) the planned action is near 0, in one device's share of two."""
    settings = tiny(
        algo="pets", total_steps=240, epoch_steps=240, episode_length=3, warmup_steps=120, model_update_every=40,
        replay_capacity=1000, model_hidden_size=32, model_batch_size=32, model_max_epochs=40, plan_horizon=3,
        plan_population=40, plan_elites=5, plan_iterations=4, plan_particles=4, devices=2,
    )  # fmt: skip
    driver = make_driver(kind, False, settings)
    state, news = driver.run(driver.init(*initial_inputs(settings)), settings.epoch_steps // settings.stride)
    lines = metrics.episode_lines(news, 0, settings)
    np.testing.assert_array_equal(state.seeds.memory, 0)  # an episode has just ended; its plan is forgotten
    planned = [line["return"] for line in lines if not line["random"]]
    assert np.mean(planned[-10:]) > 0.8  # uniform actions: 2/3
    assert {(line["model"], line["policy"], len(line["probs"])) for line in lines} == {(0, 0, 1)}
    assert (driver.evaluate(state, evaluation_keys(settings, 0), 2).episode_return > 0.8).all()
    line = metrics.epoch_lines(state, driver.algorithm)[0]
    assert line["critic_loss"] is None
    assert line["model_val_mse"] < 0.1


def test_particles_must_be_shared_evenly():
    with pytest.raises(SettingError, match="plan_particles=5: must be a multiple of n_models=2"):
        tiny(algo="pets", plan_particles=5)
