"""TRPO against dense algebra and values worked by hand, SLBO's loss, and whole runs."""

import runpy

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.flatten_util import ravel_pytree

from tests.helpers import algorithm as make_algorithm
from tests.helpers import constant, new_model, tiny
from tests.learners import make_driver
from vecpsmbpo import dynamics, metrics, replay
from vecpsmbpo.algorithms.slbo import multistep, networks, trpo
from vecpsmbpo.envs import specs
from vecpsmbpo.look import export
from vecpsmbpo.programs import evaluation_keys, initial_inputs
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec, Scaling, Transition

SPEC = specs.get("ball_in_cup")
NETS = trpo.make_networks(tiny(algo="slbo", policy_hidden_size=6), SPEC)


@pytest.fixture
def policy(key):
    params = NETS.policy.init(key, jnp.zeros(SPEC.obs_size))
    return jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key, x.shape), params)


# ── the policy's distribution ────────────────────────────────────────────────────────────────────────────────────


def test_normal_against_scipy():
    random = np.random.default_rng(0)
    loc, log_std, action = random.normal(size=(3, 50, 2))
    distribution = networks.Normal(jnp.asarray(loc), jnp.asarray(log_std))
    theirs = scipy.stats.norm(loc, np.exp(log_std))
    np.testing.assert_allclose(distribution.log_prob(jnp.asarray(action)), theirs.logpdf(action).sum(-1), rtol=1e-4)
    np.testing.assert_allclose(distribution.entropy(), theirs.entropy().sum(-1), rtol=1e-4)


def test_divergence_of_normals_by_monte_carlo():
    ours = networks.Normal(jnp.array([0.5, -1.0]), jnp.array([0.2, -0.5]))
    other = networks.Normal(jnp.array([0.0, -0.5]), jnp.array([-0.1, 0.3]))
    samples = jnp.asarray(np.random.default_rng(0).normal(ours.loc, np.exp(ours.log_std), size=(200_000, 2)))
    estimate = np.mean(np.asarray(ours.log_prob(samples)) - np.asarray(other.log_prob(samples)))
    assert float(ours.divergence_to(other)) == pytest.approx(estimate, abs=0.01)
    assert float(ours.divergence_to(ours)) == 0


def test_the_policy_as_matrices_acts_on_raw_observations(key, tmp_path):
    """`act.py` in NumPy alone, and what is exported for JAX, where all of them clip and where none does."""
    slbo = make_algorithm(tiny(algo="slbo", policy_hidden_size=6), SPEC)
    params = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key, x.shape), slbo.init_agent(key).policy)
    size = SPEC.obs_size + SPEC.action_size
    scaling = Scaling(jnp.linspace(-2.0, 5.0, size), jnp.linspace(0.1, 3.0, size), jnp.ones(SPEC.obs_size + 1))
    network = slbo.feedforward((params, scaling))
    (tmp_path / "act.py").write_text(export.code(network))
    np.savez(tmp_path / "policy.npz", **network.arrays)
    alone = runpy.run_path(str(tmp_path / "act.py"))["act"]
    obs = np.random.default_rng(0).normal(size=(200, SPEC.obs_size), scale=3.0).astype(np.float32)
    expected, _ = slbo.evaluation_action((params, scaling), jnp.int32(0), (), jnp.asarray(obs), key)
    assert 0.05 < np.mean(np.abs(expected) == 1) < 0.95
    np.testing.assert_allclose(alone(obs), expected, atol=1e-4)
    np.testing.assert_allclose(network(obs, jnp), expected, atol=1e-4)


# ── TRPO ─────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_advantages_by_hand():
    """γ = 0.5, λ = 0.5; one rollout of two steps that is cut, then one that terminates."""
    reward, value, next_value = (
        jnp.array([[1.0], [2.0], [3.0]]),
        jnp.array([[4.0], [2.0], [1.0]]),
        jnp.full((3, 1), 6.0),
    )
    terminated, ended = jnp.array([[0.0], [0.0], [1.0]]), jnp.array([[False], [True], [True]])
    found = trpo.advantages(reward, value, next_value, terminated, ended, 0.5, 0.5)
    # δ = 1 + 3 - 4, 2 + 3 - 2, 3 - 1; the first reaches into the second and no further.
    np.testing.assert_allclose(found[:, 0], [0 + 0.25 * 3, 3, 2])


def test_the_natural_direction_against_a_dense_solve(policy, key):
    obs = jax.random.normal(key, (64, SPEC.obs_size))
    flat, unravel = ravel_pytree(policy)
    gradient = jax.random.normal(jax.random.fold_in(key, 1), flat.shape)
    direction, fisher = trpo.natural_direction(policy, gradient, obs, nets=NETS)

    # The Fisher matrix from its definition: E[J' F_law J], F_law = diag(1 / σ²) for the mean and 2 for log σ.
    def outputs(x):
        distribution = NETS.policy.distribution(unravel(x), obs)
        return jnp.concatenate(
            [distribution.loc * jnp.exp(-jax.lax.stop_gradient(distribution.log_std)), 2**0.5 * distribution.log_std],
            -1,
        )

    jacobian = np.asarray(jax.jacobian(outputs)(flat), np.float64)
    dense = np.einsum("bij,bik->jk", jacobian, jacobian) / len(obs) + trpo.DAMPING * np.eye(flat.size)
    np.testing.assert_allclose(fisher(gradient), dense @ gradient, rtol=1e-3, atol=1e-3)
    expected = np.linalg.solve(dense, np.asarray(gradient, np.float64))
    # Ten iterations are not a solution; they come close to it, and closer in the metric that matters.
    error = direction - expected
    assert error @ dense @ error < 0.02 * expected @ dense @ expected


def test_a_step_improves_the_surrogate_within_the_trust_region(policy, key):
    keys = jax.random.split(key, 3)
    obs = jax.random.normal(keys[0], (512, SPEC.obs_size))
    distribution = NETS.policy.distribution(policy, obs)
    action = distribution.sample(keys[1])
    advantage = -jnp.sum((action - 0.5) ** 2, axis=-1)  # actions near 0.5 are good
    rows = obs, action, (advantage - advantage.mean()) / advantage.std()
    for region in (0.001, 0.01, 0.1):
        after, gain = trpo.policy_step(policy, rows, trust_region=region, entropy_weight=0.0, nets=NETS)
        moved = float(trpo.divergence(after, policy, obs, nets=NETS))
        assert 0.2 * region < moved <= region * 1.001
        old = distribution.log_prob(action)
        gained = trpo.surrogate(after, old, rows, 0.0, nets=NETS) - trpo.surrogate(policy, old, rows, 0.0, nets=NETS)
        assert 0 < float(gained) == pytest.approx(float(gain), abs=1e-5)


def test_without_a_better_step_the_policy_stays(policy, key):
    """No advantage anywhere: there is nothing to gain."""
    obs = jax.random.normal(key, (32, SPEC.obs_size))
    action = NETS.policy.distribution(policy, obs).sample(key)
    after, gain = trpo.policy_step(
        policy, (obs, action, jnp.zeros(32)), trust_region=0.01, entropy_weight=0.0, nets=NETS
    )
    jax.tree.map(np.testing.assert_array_equal, after, policy)
    assert float(gain) == 0


# ── the model ────────────────────────────────────────────────────────────────────────────────────────────────────

LINE = EnvSpec("line", obs_size=2, action_size=1, episode_length=10, terminated=lambda o, a, n: n[..., 0] > 9)


def test_the_multistep_loss_by_hand(key):
    """A model that always moves by (1, 2) and pays 3, on two true steps of (1, 2), 3 and (4, 6), 7."""
    settings = tiny(algo="slbo")
    model = new_model(key, settings, LINE)
    model = model.replace(
        params=constant(model.params, jnp.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])),
        scaling=model.scaling._replace(input_std=jnp.array([1.0, 2.0, 1.0])),
    )
    obs = jnp.array([[[0.0, 0.0], [1.0, 2.0]]])
    next_obs = jnp.array([[[1.0, 2.0], [5.0, 8.0]]])
    batch = Transition(obs, jnp.zeros((1, 2, 1)), jnp.array([[3.0, 7.0]]), next_obs, jnp.zeros((1, 2)))
    net = dynamics.network(settings, LINE)
    both = multistep.loss(model, batch, jnp.array([[True, True]]), net=net)
    # The second step is off by (3, 4 / 2) and 4: the root of 9 + 4 + 16.
    assert float(both) == pytest.approx(np.sqrt(29) / 2, abs=1e-5)
    assert float(multistep.loss(model, batch, jnp.array([[True, False]]), net=net)) == pytest.approx(0, abs=1e-5)


def test_sequences_do_not_cross_episodes(key):
    """Episodes of 5 rows: states 0..5, 100..105, …; a sequence counts until the episode ends."""
    settings = tiny(algo="slbo", model_steps_ahead=3, model_batch_size=64)
    episode, step = np.divmod(np.arange(20), 5)
    obs = np.stack([100.0 * episode + step, np.zeros(20)], axis=1)
    next_obs = obs + np.array([1.0, 0.0])
    rows = Transition(*map(jnp.asarray, (obs, np.zeros((20, 1)), np.zeros(20), next_obs, np.zeros(20))))
    real = jnp.zeros((30, replay.row_size(2, 1))).at[:20].set(replay.pack(rows))
    batch, follows = multistep.sequences(real, jnp.int32(20), key, settings, LINE)
    first = np.asarray(batch.obs[:, 0, 0]).astype(int)
    left = 4 - first % 100  # rows of the episode after this one
    np.testing.assert_array_equal(follows[:, 1], left >= 1)
    np.testing.assert_array_equal(follows[:, 1] & follows[:, 2], left >= 2)
    assert 0 < follows[:, 1].mean() < 1
    assert first.max() >= 300  # the last episode is drawn from, too


# ── whole runs ───────────────────────────────────────────────────────────────────────────────────────────────────


@pytest.mark.parametrize(("kind", "terminates"), [("scan", False), ("host", True)])
def test_a_run_learns_the_probe(kind, terminates):
    """Reward 1 - a² at every other step: the mean action goes to 0 from where random actions are."""
    settings = tiny(
        algo="slbo", total_steps=360, epoch_steps=360, episode_length=3, warmup_steps=120, model_update_every=40,
        replay_capacity=1000, model_hidden_size=32, model_batch_size=32, model_steps=200, rounds=2, policy_steps=20,
        policy_rollouts=20, policy_rollout_length=10, discount=0.5, model_learning_rate=1e-3,
    )  # fmt: skip
    driver = make_driver(kind, terminates, settings)
    state, news = driver.run(driver.init(*initial_inputs(settings)), settings.epoch_steps // settings.stride)
    assert (driver.evaluate(state, evaluation_keys(settings, 0), 2).episode_return > 0.9).all()
    line = metrics.epoch_lines(state, driver.algorithm)[0]
    periods = (settings.total_steps - settings.warmup_steps) // settings.model_update_every
    assert float(state.seeds.agents.stats.updates[0, 0]) == periods * settings.rounds * settings.policy_steps
    assert line["model_loss"] < 0.2
    assert line["model_val_mse"] is None  # nothing validates
    assert np.isfinite([line[name] for name in ("critic_loss", "actor_loss", "entropy", "q_mean")]).all()
    random = np.mean([episode["return"] for episode in metrics.episode_lines(news, 0, settings) if episode["random"]])
    assert random < 0.8


def test_one_model_and_one_policy():
    with pytest.raises(SettingError, match="must be 1 with algo=slbo"):
        tiny(algo="slbo", n_models=2)
