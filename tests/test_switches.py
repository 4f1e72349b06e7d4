"""The paper's ablations: every switch changes what it should and nothing else."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from tests import probes
from tests.helpers import algorithm, assert_probabilities_follow, constant, initial, new_model, tiny
from tests.learners import make_driver, settings_for
from vecpsmbpo import dynamics, metrics, posterior, sac, schedule
from vecpsmbpo.envs import specs
from vecpsmbpo.programs import initial_inputs
from vecpsmbpo.types import Counters, Hyper, Transition

# ── a learning rate that cools down ──────────────────────────────────────────────────────────────────────────────


def test_the_learning_rate_falls_to_a_twentieth_in_the_last_share_of_the_run():
    """Adam's first step moves a parameter by the learning rate: here log α, with 400 steps, the last 100 of which cool
    down."""
    rate = 0.01
    settings = tiny(
        n_models=1,
        n_policies=1,
        updates_per_step=1,
        total_steps=400,
        policy_learning_rate=rate,
        policy_learning_rate_cooldown=0.25,
        devices=1,
    )
    learner = algorithm(settings, probes.spec(False))
    parts, state = learner.layout.specs(), initial(learner)
    learn = learner.layout.jit_shard_map(
        lambda c, s: schedule.over_seeds(learner.learn)(c, s, s.key), (parts.counters, parts.seeds), parts.seeds.agents
    )
    for step, left in ((100, 1.0), (300, 1.0), (350, 0.5), (395, 0.05), (400, 0.05)):
        after = learn(Counters(jnp.int32(step), jnp.int32(16)), state)
        moved = np.abs(after.log_alpha - state.agents.log_alpha)
        np.testing.assert_allclose(moved, rate * left, rtol=1e-3)


# ── forced exploration (equation 33) ─────────────────────────────────────────────────────────────────────────────


def test_forced_exploration_by_hand():
    episodes = jnp.array([1, 4, 5, 10, 100])
    np.testing.assert_allclose(posterior.exploration_probability(5.0, episodes), [1, 1, 1, 0.5, 0.05], rtol=1e-6)
    np.testing.assert_array_equal(posterior.exploration_probability(0.0, episodes), np.zeros(5))


def test_a_random_action_is_held_and_each_episode_begins_with_a_new_one(key):
    """A truncated episode of five steps and the beginning of the next, where actions are kept for three."""
    settings = tiny(random_hold=3, devices=1)
    learner = algorithm(settings, probes.spec(True))

    def play(counters, key):
        def step(state, t):
            act_key, observe_key = jax.random.split(jax.random.fold_in(key, t))
            action, _ = learner.act(counters, state, jnp.zeros(1), act_key)
            row = Transition(jnp.zeros(1), action, jnp.float32(0), jnp.zeros(1), jnp.float32(0))
            return learner.observe(counters, state, row, t == 4, observe_key)[0], action[0]

        return jax.lax.scan(step, learner.init(jax.random.key(0), Hyper.of(settings)), jnp.arange(8))[1]

    shared = learner.layout.specs().counters
    actions = learner.layout.jit_shard_map(play, (shared, shared), shared)(Counters(jnp.int32(0), jnp.int32(0)), key)
    first, second, third = actions[0], actions[3], actions[5]
    np.testing.assert_array_equal(actions, [first] * 3 + [second] * 2 + [third] * 3)
    assert len({float(first), float(second), float(third)}) == 3


# ── random function prior (equation 34) ──────────────────────────────────────────────────────────────────────────


def test_the_prior_is_added_to_the_network_and_never_fitted(key):
    settings, spec = tiny(prior_scale=0.3), specs.get("hopper")
    hyper = Hyper.of(settings)
    model = new_model(key, settings, spec, hyper)
    plain = new_model(key, tiny(), spec, hyper)
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


# ── all of them in a run ─────────────────────────────────────────────────────────────────────────────────────────


def run(kind="scan", **changes):
    settings = settings_for(updates_per_step=1, total_steps=600, epoch_steps=120, **changes)
    driver = make_driver(kind, True, settings)
    state, lines, epochs = driver.init(*initial_inputs(settings)), [], []
    for epoch in range(settings.total_steps // settings.epoch_steps):
        state, news = driver.run(state, settings.epoch_steps // settings.stride)
        lines += metrics.episode_lines(news, epoch * settings.epoch_steps, settings)
        epochs += metrics.epoch_lines(state, driver.algorithm)
    return settings, driver, state, lines, epochs


@pytest.fixture(scope="module")
def plain():
    """The final state of the run in which nothing is switched on."""
    return run(real_ratio=0.4)[2]


@pytest.fixture(scope="module")
def averaged():
    """All switches that go together, for two values of τ in one program."""
    return run(posterior="average", prior_scale=0.3, real_ratio=0.4, **{"sweep.forced_exploration": [0.0, 60.0]})


RATIOS = [0.3, 0.9]
EXPLORATION = [0.0, 1e9]  # τ: none, and all episodes random


@pytest.fixture(scope="module")
def adapted():
    """λ chosen online, one policy of each model with either."""
    return run(
        real_ratio_schedule="bandit",
        real_ratio_arms=RATIOS,
        temperature=100.0,
        **{"sweep.forced_exploration": EXPLORATION},
    )


def test_with_the_average_no_member_acts_or_is_credited(averaged):
    settings, _, state, lines, _ = averaged
    assert {(line["model"], line["policy"]) for line in lines} == {(None, None)}
    np.testing.assert_allclose([line["probs"] for line in lines], 1 / settings.n_members, rtol=1e-6)
    np.testing.assert_array_equal(state.seeds.posterior.returns, 0)


def test_the_first_episode_after_the_warm_up_has_k_1(key):
    """Equation 33 at τ = 1: it is random for certain, the second one with probability one half."""
    settings = tiny(forced_exploration=1.0)
    learner = algorithm(settings, probes.spec(False))
    earned, hyper = posterior.init(settings.n_members), Hyper.of(settings)

    def random(index):
        begin = lambda k: learner._begin_episode(  # noqa: E731
            earned, None, hyper, jnp.int32(index), jnp.int32(60), jnp.bool_(False), k
        )
        return jax.vmap(begin)(jax.random.split(key, 400)).random

    assert random(61).all()
    assert 160 < random(62).sum() < 240  # four standard deviations around 200


def test_swept_values_run_side_by_side(averaged):
    """Of 240 episodes after the warm-up, none is random at τ = 0; at 60 those with probability min(1, 60 / k), where
    the first of them has k = 1."""
    settings, _, state, lines, epochs = averaged
    assert [lane["forced_exploration"] for lane in settings.lanes] == [0.0, 60.0]
    np.testing.assert_array_equal(state.seeds.hyper.forced_exploration, [0.0, 60.0])
    assert [(line["seed"], line["forced_exploration"]) for line in epochs[:2]] == [(0, 0.0), (0, 60.0)]
    late = {
        value: [line for line in lines if line["forced_exploration"] == value and line["env_steps"] >= 122]
        for value in (0.0, 60.0)
    }
    assert not any(line["random"] for line in late[0.0])
    # Episodes of two steps: the 60 of the warm-up begin before its 120th.
    assert [line["episode"] for line in late[60.0]] == list(range(61, 301))
    assert all(line["random"] for line in late[60.0][:60])
    chances = np.array([min(1, 60 / (line["episode"] - 60)) for line in late[60.0]])
    count = sum(line["random"] for line in late[60.0])
    assert abs(count - chances.sum()) < 4 * np.sqrt((chances * (1 - chances)).sum())


def test_each_policy_learns_with_its_own_ratio(adapted):
    """Where all episodes are random, runs with different λ see the same data: policy m of the bandit's run is policy m
    of the run with the constant λ of its arm."""
    constants = run(forced_exploration=EXPLORATION[1], **{"sweep.real_ratio": RATIOS})[2].seeds.agents.actor
    settings, _, state, _, _ = adapted
    for member in range(settings.n_members):
        ours = jax.tree.map(lambda x, member=member: x[1, member], state.seeds.agents.actor)
        for lane in range(2):
            theirs = jax.tree.map(lambda x, lane=lane, member=member: x[lane, member], constants)
            same = jax.tree.map(lambda a, b: np.allclose(a, b, atol=1e-5), ours, theirs)
            assert all(jax.tree.leaves(same)) == (lane == member % 2)


def test_what_is_chosen_can_be_recomputed_from_the_log(adapted):
    """Who acts by equation 19; the arms' probabilities from the discounted gains of earlier episodes, and from them the
    members' λ."""
    settings, _, _, lines, epochs = adapted
    lines, epochs = ([line for line in some if line["forced_exploration"] == 0.0] for some in (lines, epochs))
    assert_probabilities_follow(lines, settings.n_models, settings)
    history, rounds = {0: [], 1: []}, 0  # return and round
    low, high = 0.0, 0.0

    def arm_probabilities():
        laws = []
        for arm in (0, 1):
            ages = [
                math.prod(1 - 1 / (8 * math.sqrt(r)) for r in range(born + 1, rounds + 1)) for _, born in history[arm]
            ]
            wins = sum(age * (value - low) for age, (value, _) in zip(ages, history[arm], strict=True))
            wins = min(max(wins / max(high - low, 1e-6), 0.0), sum(ages))
            laws.append(scipy.stats.beta(1 + wins, 1 + sum(ages) - wins))
        first = scipy.integrate.quad(lambda x: laws[0].pdf(x) * laws[1].cdf(x), 0, 1, limit=200)[0]
        return np.array([first, 1 - first])

    probs, arms_played = arm_probabilities(), []
    for line in lines:
        if line["random"]:
            continue
        rank = line["policy"] * settings.n_models + line["model"]
        arm = int((rank + 0.5) / settings.n_members > probs[0])
        arms_played.append(arm)
        rounds += 1
        half = (high - low) / 2 * (1 - 1 / (8 * math.sqrt(rounds)))
        ends = [line["return"]] if rounds == 1 else [(high + low) / 2 - half, (high + low) / 2 + half, line["return"]]
        low, high = min(ends), max(ends)
        history[arm].append((line["return"], rounds))
        probs = arm_probabilities()
        if line["env_steps"] == epochs[-1]["env_steps"]:
            np.testing.assert_allclose(epochs[-1]["real_ratio_probs"], probs, atol=1e-3)
    assert line["env_steps"] == epochs[-1]["env_steps"]  # an episode ends with the run, so that this was looked at
    assert set(arms_played) == {0, 1}
    with_second = sum((rank + 0.5) / 4 > probs[0] for rank in range(4))
    assert epochs[-1]["real_ratio"] == pytest.approx((RATIOS[0] * (4 - with_second) + RATIOS[1] * with_second) / 4)


@pytest.fixture(scope="module")
def valued():
    """Members drawn by what their critics promise: settings, algorithm, state, episodes, and values of a state's
    seed."""
    settings, driver, state, lines, _ = run(weights="values", temperature=0.1, target_entropy=-0.25)
    parts = driver.layout.specs().seeds
    values = driver.layout.jit_shard_map(jax.vmap(driver.algorithm.values), (parts,), parts.key)
    return settings, driver.algorithm, state, lines, lambda seeds: values(seeds)[0]


def test_members_may_be_drawn_by_what_their_critics_promise(valued):
    """Section 3.3: probabilities are those of the values in the log, and values those of the critics at real starts."""
    settings, learner, state, lines, values = valued
    for line in lines:
        logits = np.array(line["values"]) / settings.temperature
        expected = np.exp(logits - logits.max())
        np.testing.assert_allclose(line["probs"], expected / expected.sum(), atol=1e-5)
    assert not np.any(lines[0]["values"])  # nothing is known before the first start
    assert len(np.unique(lines[-1]["values"])) == settings.n_members
    nets, start = learner.nets, jnp.zeros(1)  # where every episode begins
    seen = state.seeds.moments
    possible = [float(reward[0]) / (1 - settings.discount) for reward in (seen.lowest_reward, seen.highest_reward)]
    for member, found in enumerate(values(state.seeds)):
        agent = jax.tree.map(lambda x, member=member: x[0, member], state.seeds.agents)
        action = jnp.tanh(nets.actor.distribution(agent.actor, start).loc)
        later = settings.discount / (1 - settings.discount)
        bonus = np.exp(agent.log_alpha) * settings.target_entropy * later  # of the entropy of all later actions
        by_hand = np.min(nets.critic.values(agent.critic, start, action)) - bonus
        assert found == pytest.approx(np.clip(by_hand, *possible), rel=1e-4)


def test_no_member_promises_more_than_the_rewards_seen_allow_this_step_s_included(valued):
    """A reward of 7 ends an episode; r / (1 - γ) = 14 is then the most that anybody may promise in the next one."""
    settings, learner, state, _, _ = valued
    whole = learner.layout.specs()
    seeds, by_seed = whole.seeds, whole.seeds.key
    inputs = (whole.counters, seeds, by_seed, by_seed, by_seed)
    observe = learner.layout.jit_shard_map(schedule.over_seeds(learner.observe), inputs, (seeds, by_seed))
    boundless = jax.tree.map(lambda x: jnp.full_like(x, 1e3), state.seeds.agents.critic)
    before = state.seeds.replace(agents=state.seeds.agents.replace(critic=boundless))
    vector, number = jnp.zeros((1, 1)), jnp.zeros(1)
    step = Transition(vector, vector, number + 7, vector, number)
    after, end = observe(state.counters, before, step, jnp.array([True]), state.seeds.key)
    assert end.done.all()
    np.testing.assert_allclose(after.episode.values, 7 / (1 - settings.discount))


def test_the_start_of_an_episode_to_come_is_not_known(valued):
    """As where an evaluation follows an episode's end: its place in the ring still holds something else."""
    _, _, state, _, values = valued
    starts = state.seeds.own.starts
    at = [state.seeds.replace(own=state.seeds.own.replace(starts=jnp.full_like(starts, obs))) for obs in (0.25, 0.75)]
    ring = starts.at[:, 0].set(0.25).at[:, 1].set(0.75)
    mixed = state.seeds.replace(own=state.seeds.own.replace(starts=ring))

    def of(seeds, index, length):
        episode = seeds.episode.replace(
            index=jnp.full_like(seeds.episode.index, index), length=jnp.full_like(seeds.episode.length, length)
        )
        return values(seeds.replace(episode=episode))

    first, second = (np.asarray(of(seeds, 5, 1)) for seeds in at)
    assert not np.allclose(first, second, rtol=1e-3)
    np.testing.assert_allclose(of(mixed, 2, 0), first, rtol=1e-5)
    np.testing.assert_allclose(of(mixed, 2, 1), (first + second) / 2, rtol=1e-5)
    assert not np.any(of(mixed, 1, 0))


def test_no_member_promises_more_than_rewards_allow(valued):
    settings, _, state, _, values = valued
    agents = state.seeds.agents
    beyond = agents.replace(critic=jax.tree.map(lambda x: x + 1e4, agents.critic))
    best = 1 / (1 - settings.discount)  # of rewards 1 - a² at every step
    np.testing.assert_allclose(values(state.seeds.replace(agents=beyond)), best, rtol=1e-2)


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
    actions = learner.layout.jit_shard_map(act, (shared, shared), shared)(Counters(jnp.int32(0), jnp.int32(0)), key)
    which = np.rint(np.arctanh(np.asarray(actions)[:, 0]) * 4).astype(int)
    assert scipy.stats.chisquare(np.bincount(which, minlength=4)).pvalue > 1e-3


def _actor(learner, key):

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
