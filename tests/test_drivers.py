"""Both drivers on an environment whose value function is known in closed form (`probes`)."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests import probes
from tests.helpers import assert_probabilities_follow
from tests.learners import DISCOUNT, STEPS, make_driver, settings_for
from vecpsmbpo import metrics, placement, replay, sac
from vecpsmbpo.drivers import Stopped
from vecpsmbpo.drivers.common import split_for_episodes
from vecpsmbpo.programs import evaluation_keys, initial_inputs

EVALUATED = 5  # steps of an evaluation's episode; those that are learned from are shorter


CASES = [
    ("scan", False, "ops_mbpo"),
    ("scan", True, "ops_mbpo"),
    ("scan", True, "mbpo"),
    ("scan", False, "sac"),
    ("host", False, "ops_mbpo"),
    ("host", True, "mbpo"),
]


@pytest.fixture(scope="module", params=CASES, ids=str)
def trained(request):
    kind, terminates, algo = request.param
    settings = settings_for(algo=algo, episode_length=EVALUATED, train_episode_length=probes.EPISODE_LENGTH)
    driver = make_driver(kind, terminates, settings)
    state, news = driver.run(driver.init(*initial_inputs(settings)), settings.epoch_steps // settings.stride)
    return settings, driver, terminates, state, news


def test_every_step_has_an_action_of_its_own(trained):
    """Within a stride, and from one to the next: of random actions no two are the same."""
    settings, driver, _, state, _ = trained
    spec = driver.algorithm.spec
    for real in state.seeds.real[:, : settings.warmup_steps]:
        action = np.asarray(replay.unpack(real, spec.obs_size, spec.action_size).action)
        assert len(np.unique(action, axis=0)) == settings.warmup_steps


def test_q_is_the_known_value_function(trained):
    """Q(s, π(s)) = V(s) for every member; at actions that no policy takes, Q is extrapolation."""
    settings, driver, terminates, state, _ = trained
    first = 1.0 if terminates else 1 / (1 - DISCOUNT**2)
    for member in range(settings.n_members):
        assert _value(driver, state, member, 1.0) == pytest.approx(first, abs=0.2)
        assert _value(driver, state, member, 0.0) == pytest.approx(DISCOUNT * first, abs=0.2)


def _value(driver, state, member, obs):
    """min(Q_1, Q_2) of one member of the first seed at its own mean action."""
    nets = sac.make_networks(driver.settings, driver.algorithm.spec)
    agent = jax.tree.map(lambda x: x[0, member], state.seeds.agents)
    obs = jnp.array([obs])
    return float(jnp.minimum(*nets.critic.values(agent.critic, obs, nets.actor.distribution(agent.actor, obs).mode())))


def test_policies_are_optimal(trained):
    settings, driver, _, state, _ = trained
    nets = sac.make_networks(settings, driver.algorithm.spec)
    actors = jax.tree.map(lambda x: x[0], state.seeds.agents.actor)
    actions = jax.vmap(lambda actor: nets.actor.distribution(actor, jnp.ones(1)).mode())(actors)
    assert np.abs(actions[: settings.n_members]).max() < 0.35  # reward 1 - a²: at least 0.88 of the best


def test_stored_transitions_are_the_true_ones(trained):
    """Also at episode ends: the successor is 1 - obs and never the state after the reset."""
    _, _, terminates, state, _ = trained
    rows = replay.unpack(state.seeds.real[0, :STEPS], 1, 1)
    np.testing.assert_array_equal(rows.next_obs, 1 - rows.obs)
    np.testing.assert_array_equal(rows.terminated, (rows.obs[:, 0] > 0.5) & terminates)
    np.testing.assert_allclose(rows.reward, rows.obs[:, 0] * (1 - rows.action[:, 0] ** 2), atol=1e-6)
    assert np.abs(rows.action).max() <= 1


def test_episodes_are_accounted_for(trained):
    settings, _, terminates, state, news = trained
    lines = metrics.episode_lines(news, 0, settings)
    length = 2 if terminates else probes.EPISODE_LENGTH
    assert [line["episode"] for line in lines] == list(range(1, STEPS // length + 1))
    assert all(line["length"] == length and line["env_steps"] == length * line["episode"] for line in lines)
    assert all(line["terminated"] == terminates for line in lines)
    # Random while the warm-up lasts: an episode that began before its end stays random to its own end.
    assert all(line["random"] == (line["env_steps"] - length < settings.warmup_steps) for line in lines)
    rows = replay.unpack(state.seeds.real[0, :STEPS], 1, 1)
    for line in lines[::7]:
        inside = slice(line["env_steps"] - length, line["env_steps"])
        assert line["return"] == pytest.approx(float(rows.reward[inside].sum()), rel=1e-5)


def test_the_log_alone_gives_the_probabilities_of_equation_19(trained):
    settings, _, _, _, news = trained
    lines = metrics.episode_lines(news, 0, settings)
    assert assert_probabilities_follow(lines, settings.n_members // settings.n_policies, settings).sum() > 0


def test_evaluation_plays_whole_episodes_of_the_mean_action(trained):
    settings, driver, terminates, state, _ = trained
    returns = driver.evaluate(state, evaluation_keys(settings, STEPS), 3)
    assert returns.episode_return.shape == (1, 3)
    assert (returns.length == (2 if terminates else EVALUATED)).all()
    assert (returns.episode_return > (0.85 if terminates else 1.7)).all()  # one and two steps are rewarded


def test_an_evaluation_can_be_stopped(trained):
    settings, driver, _, state, _ = trained
    with pytest.raises(Stopped):
        driver.evaluate(state, evaluation_keys(settings, STEPS), 3, lambda: True)


def test_inputs_are_whitened_by_all_the_data(trained):
    _, _, _, state, _ = trained
    rows = np.asarray(state.seeds.real[0, :STEPS])
    # obs and action, and what is predicted from them: the change and the reward.
    inputs = np.concatenate([rows[:, :2], rows[:, 2:3] - rows[:, :1], rows[:, 3:4]], axis=1)
    moments = jax.tree.map(lambda x: x[0], state.seeds.moments)
    np.testing.assert_allclose(moments.mean, inputs.mean(0), atol=1e-5)
    np.testing.assert_allclose(moments.deviation / STEPS, inputs.var(0), atol=1e-4)


def test_an_epoch_compiles_once_whatever_the_data_size_and_chunks_do_not_matter():
    """Chunks of 1, 8, 4 and 7 strides of half a period: one compilation, and the same run as a chunk of 20. Other
    hyperparameters are no other program either."""
    settings = settings_for(updates_per_step=1)
    driver = make_driver("scan", True, settings)
    whole, _ = driver.run(driver.init(*initial_inputs(settings)), 20)
    keys, hyper = initial_inputs(settings)
    state, changed = driver.init(keys, hyper), jax.tree.map(lambda x: 0.9 * x, hyper)
    compiled: list[str] = []

    def listen(event, duration, **kwargs):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for strides in (1, 8, 4, 7):
            state, _ = driver.run(state, strides)
        other, _ = driver.run(driver.init(keys, changed), 20)
        assert not compiled
        jax.jit(lambda x: x + len(compiled))(jnp.ones(3))
        assert compiled  # the listener does hear compilations
    finally:
        jax.monitoring.clear_event_listeners()
    jax.tree.map(np.testing.assert_array_equal, whole.seeds.agents.actor, state.seeds.agents.actor)
    different = jax.tree.map(lambda a, b: not np.array_equal(a, b), whole.seeds.agents.actor, other.seeds.agents.actor)
    assert all(jax.tree.leaves(different))


def test_only_real_data_needs_no_models():
    """λ = 1 (equation 15): models stay as they were, policies learn; λ = 0 (equation 14) learns from models alone."""
    driver = make_driver("scan", True, settings_for())
    keys, hyper = initial_inputs(driver.settings)
    for ratio, fitted in ((1.0, False), (0.0, True)):
        start = driver.init(keys, hyper.replace(real_ratio=jnp.full(1, ratio)))
        before = jax.tree.map(np.asarray, start.seeds.models.params)
        state, _ = driver.run(start, driver.settings.epoch_steps // driver.settings.stride)
        after = state.seeds.models.params
        same = all(np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (before, after)), strict=True))
        assert same != fitted
        assert (int(state.counters.imagined_rows) > 0) == fitted
        assert _value(driver, state, 0, 1.0) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("algo", ["ops_mbpo", "pets", "slbo"])
def test_seeds_differ_and_are_what_they_are_alone(algo):
    own = {"pets": {"plan_hold": 1}, "ops_mbpo": {"updates_per_step": 1}}.get(algo, {})
    settings = settings_for(num_seeds=2, algo=algo, **own)
    driver = make_driver("scan", True, settings)
    state, news = driver.run(driver.init(*initial_inputs(settings)), 200 // settings.stride)
    actions = np.asarray(state.seeds.real[:, :200, 1])
    assert (actions[0] != actions[1]).mean() > 0.9
    alone = dataclasses.replace(settings, num_seeds=1, seed=settings.seed + 1)
    single = make_driver("scan", True, alone)
    state, _ = single.run(single.init(*initial_inputs(alone)), 200 // settings.stride)
    # Until learning begins nothing can differ; afterwards rounding does, since the mesh is another.
    np.testing.assert_array_equal(actions[1, :120], state.seeds.real[0, :120, 1])
    if algo != "pets":  # which takes the best of noisy candidates: rounding can change which
        np.testing.assert_allclose(actions[1], state.seeds.real[0, :200, 1], atol=0.05)
    seeds = {line["seed"] for line in metrics.episode_lines(news, 0, settings)}
    assert seeds == {0, 1}


def _four_policies(settings, driver):
    """A state in which policy i always acts tanh(i / 4), give or take 1e-3, and the second has earned the most."""
    state = driver.init(*initial_inputs(settings))
    assert driver.algorithm.spec.action_size == 1
    actor = jax.tree.map(jnp.zeros_like, state.seeds.agents.actor)
    bias = jnp.stack([jnp.array([i / 4, -1e3]) for i in range(4)])[None]
    actor["params"]["ReluMLP_0"]["Dense_2"]["bias"] = bias
    posterior = state.seeds.posterior.replace(returns=jnp.array([[0.0, 9e9, 0, 0]]), episodes=jnp.ones((1, 4), int))
    seeds = state.seeds.replace(agents=state.seeds.agents.replace(actor=actor), posterior=posterior)
    return placement.place(driver.layout, state.replace(seeds=seeds))


ACTIONS = np.tanh(np.arange(4) / 4)  # of which the probe rewards 1 - a²


@pytest.mark.parametrize(
    ("policy", "algo", "action"),
    [("best", "ops_mbpo", ACTIONS[1]), ("best", "ps_mbpo", ACTIONS[1]), ("average", "ops_mbpo", ACTIONS.mean())],
)
def test_other_evaluation_policies(policy, algo, action):
    settings = settings_for(eval_policy=policy, algo=algo)
    driver = make_driver("scan", True, settings)
    returns = driver.evaluate(_four_policies(settings, driver), evaluation_keys(settings, 0), 1)
    assert float(returns.episode_return[0, 0]) == pytest.approx(1 - action**2, abs=1e-4)


@pytest.mark.parametrize(("arms", "fitted"), [([1.0], False), ([0.3, 1.0], True)])
def test_a_choice_among_real_data_alone_needs_no_models(arms, fitted):
    settings = settings_for(real_ratio_schedule="bandit", real_ratio_arms=arms, total_steps=160, epoch_steps=160)
    assert settings.imagines == fitted
    driver = make_driver("scan", True, settings)
    state, _ = driver.run(driver.init(*initial_inputs(settings)), settings.epoch_steps // settings.stride)
    assert (np.asarray(state.seeds.models.optimizer.count) > 0).all() == fitted


def test_the_average_of_policies_is_evaluated_as_it_acts():
    """With `posterior=average` every step is some member's mean action, never the mean of several."""
    settings = settings_for(posterior="average", eval_episodes=40)
    driver = make_driver("scan", True, settings)
    state = _four_policies(settings, driver)
    returns = np.asarray(driver.evaluate(state, evaluation_keys(settings, 0), 40).episode_return[0])
    nearest = np.abs(returns[:, None] - (1 - ACTIONS**2))
    assert nearest.max(axis=0).min() > 0.1
    assert nearest.min(axis=1).max() < 1e-4
    assert set(nearest.argmin(axis=1)) == {0, 1, 2, 3}


def test_no_key_of_an_evaluation_is_used_twice(key):
    """Whatever a reset splits its key into, no step's action is drawn with it; nor with another episode's."""
    _, resets, actions = split_for_episodes(key[None], 3)
    of_resets = [jax.vmap(lambda k, count=count: jax.random.split(k, count))(resets[0]) for count in (2, 4)]
    of_steps = jax.vmap(lambda k: jax.vmap(lambda t: jax.random.fold_in(k, t))(jnp.arange(5)))(actions[0])
    used = {tuple(row) for keys in of_resets for row in np.asarray(jax.random.key_data(keys)).reshape(-1, 2)}
    steps = {tuple(row) for row in np.asarray(jax.random.key_data(of_steps)).reshape(-1, 2)}
    assert len(steps) == 15
    assert not steps & used
    assert {
        len({tuple(row) for row in np.asarray(jax.random.key_data(k)).reshape(-1, 2)}) for k in (resets, actions)
    } == {3}


@pytest.mark.parametrize(("policy", "members"), [("best", {1}), ("average", {0, 1, 2, 3})])
def test_evaluation_with_sampled_actions(policy, members):
    settings = settings_for(eval_policy=policy, eval_actions="sampled", eval_episodes=40)
    driver = make_driver("scan", True, settings)
    returns = driver.evaluate(_four_policies(settings, driver), evaluation_keys(settings, 0), 40).episode_return[0]
    nearest = np.abs(np.asarray(returns)[:, None] - (1 - ACTIONS**2))
    assert set(nearest.argmin(axis=1)) == members
    assert nearest.min(axis=1).max() < 0.01  # one member's action, not a mean of several
    assert np.unique(returns).size > 10  # sampled: each with noise of its own
