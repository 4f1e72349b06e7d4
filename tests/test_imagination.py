"""D_M^{n,m} comes from model n and policy m, from real states, for the scheduled horizon."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from tests.helpers import algorithm, constant, initial, tiny
from vecpsmbpo import health, placement, replay
from vecpsmbpo.schedule import over_seeds
from vecpsmbpo.types import Counters, EnvSpec, Transition

LIMIT = 3.5
SPEC = EnvSpec("counter", obs_size=2, action_size=1, episode_length=10, terminated=lambda o, a, n: n[..., 0] > LIMIT)
N, M, ROWS = 3, 2, 40


@pytest.fixture(scope="module")
def imagined():
    return imagine(tiny(n_models=N, n_policies=M, rollout_starts=8, horizon_first=3, horizon_last=3))


def imagine(settings, change=1.0):
    """The rows that one refresh adds for every member, D_E, and what it says of its health.

    Every model n adds (n + 1) · change to obs[0] and pays n; every policy acts near tanh(index / 10).
    """
    learner = algorithm(settings, SPEC)
    layout = learner.layout
    specs = layout.specs()
    state = placement.unpad(layout, _train_state(initial(learner)))
    seeds = state.seeds

    def model_params(n):
        quiet = jnp.full(3, -1e3)
        return jnp.concatenate([jnp.array([(n + 1) * change, 0.0, n]), quiet])

    outputs = jnp.stack([model_params(n) for n in range(N)])[None]
    actions = jnp.stack([jnp.array([i / 10, -1e3]) for i in range(settings.n_members)])[None]
    actor = seeds.agents.actor
    inner = constant({"params": actor["params"]["ReluMLP_0"]}, actions)["params"]
    seeds = seeds.replace(
        models=seeds.models.replace(params=constant(seeds.models.params, outputs)),
        agents=seeds.agents.replace(actor={"params": {"ReluMLP_0": inner}}),
        real=_real_rows(seeds.real),
    )
    placed = placement.place(layout, state.replace(seeds=seeds)).seeds
    run = layout.jit_shard_map(
        lambda counters, seeds, keys: over_seeds(
            lambda c, s, k: learner.imagine(c, s, jnp.bool_(True), k), out_axes=(None, 0)
        )(counters, seeds, keys),
        (specs.counters, specs.seeds, specs.seeds.key),
        (specs.counters, specs.seeds),
    )
    counters = Counters(jnp.int32(ROWS), jnp.int32(0))
    counters, after = run(counters, placed, placed.key)
    added = settings.horizon_last * settings.rollout_starts
    rows = after.imagined[0, : settings.n_members, :added]
    assert int(counters.imagined_rows) == added
    return [replay.unpack(member, 2, 1) for member in rows], np.asarray(after.real[0]), after.health


def _train_state(seeds):
    from vecpsmbpo.types import TrainState

    return TrainState(Counters(jnp.int32(0), jnp.int32(0)), seeds, jnp.zeros((1, 2)))


def _real_rows(ring):
    """Real states (0, i), i < ROWS; the rest of the ring is poison."""
    obs = jnp.stack([jnp.zeros(ROWS), jnp.arange(ROWS, dtype=jnp.float32)], axis=1)
    zero = jnp.zeros(ROWS)
    rows = replay.pack(Transition(obs, zero[:, None], zero, obs, zero))
    return jnp.full_like(ring, jnp.nan).at[0, :ROWS].set(rows)


def test_every_member_s_data_comes_from_its_own_model(imagined):
    for member, data in enumerate(imagined[0]):
        n = member // M
        # The smallest variance the network can express leaves noise of exp(-5) = 0.0067.
        np.testing.assert_allclose(data.next_obs[:, 0] - data.obs[:, 0], n + 1, atol=0.04)
        np.testing.assert_allclose(data.reward, n, atol=0.04)


def test_every_member_s_data_comes_from_its_own_policy(imagined):
    for member, data in enumerate(imagined[0]):
        np.testing.assert_allclose(data.action[:, 0], np.tanh(member / 10), atol=0.01)


def test_rollouts_start_from_stored_real_states_and_go_on_for_the_horizon(imagined):
    for member, data in enumerate(imagined[0]):
        first, second = (jax.tree.map(lambda x, s=s: x[s], data) for s in (slice(0, 8), slice(8, 16)))
        assert np.isin(first.obs[:, 1], np.arange(ROWS)).all()
        assert (first.obs[:, 0] == 0).all()
        if member // M < 2:  # models 0 and 1 are below the limit then: the second step goes on from the first
            np.testing.assert_array_equal(second.obs, first.next_obs)


def test_a_rollout_that_terminates_is_stored_and_begins_again_from_a_real_state(imagined):
    """Model 2 adds 3 to obs[0] and passes the limit of 3.5 at its second step."""
    data = imagined[0][2 * M]
    np.testing.assert_array_equal(data.terminated[:8], 0)
    np.testing.assert_array_equal(data.terminated[8:16], 1)
    np.testing.assert_allclose(data.next_obs[8:16, 0], 6, atol=0.1)
    np.testing.assert_array_equal(data.obs[16:24, 0], 0)
    assert np.isin(data.obs[16:24, 1], np.arange(ROWS)).all()


def test_what_a_model_makes_infinite_is_noted_and_not_stored(imagined):
    """Model 0 comes to -3e38 within three steps; the others pass float32's -3.4e38 at their second, n = 1 first."""
    assert int(imagined[2].passing[0]) == health.NOWHERE
    settings = tiny(n_models=N, n_policies=M, rollout_starts=8, horizon_first=3, horizon_last=3)
    rows, _, after = imagine(settings, change=-1e38)
    expected = health.note(health.init(), health.IMAGINED, jnp.bool_(True), M)  # the first member of model 1
    assert int(after.passing[0]) == int(expected.passing)
    for member, data in enumerate(rows):
        assert all(np.isfinite(leaf).all() for leaf in data)
        lost = [t for t in range(3) if not np.any(data.next_obs[8 * t : 8 * t + 8])]
        assert lost == ([] if member < M else [1, 2])


def test_mbpo_draws_a_model_for_every_row_and_step():
    settings = tiny(algo="mbpo", n_models=N, rollout_starts=900, horizon_first=3, horizon_last=3)
    (data,), _, _ = imagine(settings)  # one policy
    n = np.round(data.reward).astype(int)
    assert scipy.stats.chisquare(np.bincount(n, minlength=N)).pvalue > 1e-4
    # The whole answer is one model's.
    np.testing.assert_allclose(data.next_obs[:, 0] - data.obs[:, 0], n + 1, atol=0.04)
    np.testing.assert_allclose(data.reward, n, atol=0.04)
    # The model of a row's second step says nothing of the one of its third.
    pairs = np.bincount(n[900:1800] * N + n[1800:], minlength=N * N)
    assert scipy.stats.chisquare(pairs).pvalue > 1e-4
