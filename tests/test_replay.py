"""The ring buffer, and the λ mixture drawn from two of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from tests import probes
from tests.helpers import algorithm, initial, tiny
from vecpsmbpo import replay
from vecpsmbpo.types import Counters, Transition


def test_pack_and_unpack_are_inverse(key):
    keys = jax.random.split(key, 4)
    transition = Transition(
        jax.random.normal(keys[0], (7, 3)),
        jax.random.normal(keys[1], (7, 2)),
        jax.random.normal(keys[2], (7,)),
        jax.random.normal(keys[3], (7, 3)),
        jnp.array([0.0, 1, 0, 1, 0, 0, 1]),
    )
    rows = replay.pack(transition)
    assert rows.shape == (7, replay.row_size(3, 2))
    jax.tree.map(np.testing.assert_array_equal, replay.unpack(rows, 3, 2), transition)


def test_the_ring_keeps_the_newest_rows():
    ring = replay.init(6, 1, 1)
    for block in range(5):
        rows = jnp.full((2, 5), block, jnp.float32)
        ring = replay.add(ring, rows, jnp.int32(2 * block))
    np.testing.assert_array_equal(ring[:, 0], [3, 3, 4, 4, 2, 2])


def test_the_count_keeps_position_and_fullness_and_never_overflows():
    added = exact = 0
    for new in (3, 4, 5, 6, 7, 3, 9):
        added, exact = int(replay.wrapped(jnp.int32(added + new), 8)), exact + new
        assert added % 8 == exact % 8
        assert min(added, 8) == min(exact, 8)
        assert added < 16


def test_only_stored_rows_are_drawn(key):
    indices = replay.sample_indices(key, (1000,), jnp.int32(10), 64)
    assert set(np.asarray(indices).tolist()) == set(range(10))


def test_the_newest_rows_are_those_last_added(key):
    """Rows 10 to 15 of 16 in a ring of 8 lie at 2 to 7; of a ring not yet full, at the end of what is there."""
    draw = lambda added, newest: replay.sample_newest_indices(key, (1000,), jnp.int32(added), 8, jnp.int32(newest))  # noqa: E731
    assert set(np.asarray(draw(16, 6)).tolist()) == {2, 3, 4, 5, 6, 7}
    assert set(np.asarray(draw(18, 4)).tolist()) == {0, 1, 6, 7}
    assert set(np.asarray(draw(5, 3)).tolist()) == {2, 3, 4}
    assert set(np.asarray(draw(5, 100)).tolist()) == {0, 1, 2, 3, 4}


def test_policies_learn_from_one_epoch_of_imagined_data(key):
    """At horizon 1 of 1 to 4, a quarter of the ring: 2 refreshes of 16 rows."""
    settings = tiny(n_models=1, n_policies=1, policy_batch_size=500, real_ratio=0, horizon_last=4)
    learner = algorithm(settings, probes.spec(terminates=False))
    state = jax.tree.map(lambda x: x[0], initial(learner))
    ring = jnp.broadcast_to(jnp.arange(128.0)[:, None], state.imagined[0].shape)
    batches = jax.jit(learner.minibatches)(Counters(jnp.int32(50), jnp.int32(128 + 16)), state, ring, 0.0, key)
    assert set(np.unique(batches.reward)) == {*range(16), *range(112, 128)}


@pytest.mark.parametrize("real_ratio", [0.0, 0.05, 0.5, 1.0])
def test_each_row_of_a_minibatch_is_real_with_probability_lambda(key, real_ratio):
    """Footnote 2: per row, not per batch."""
    settings = tiny(n_models=1, n_policies=1, policy_batch_size=500, updates_per_step=40, real_ratio=real_ratio)
    learner = algorithm(settings, probes.spec(terminates=False))
    state = jax.tree.map(lambda x: x[0], initial(learner))
    state = state.replace(real=jnp.ones_like(state.real))
    counters = Counters(jnp.int32(50), jnp.int32(16))
    ring = jnp.full((128, state.real.shape[-1]), 2.0)  # given at λ = 1, too, as it is where other seeds imagine
    batches = jax.jit(learner.minibatches)(counters, state, ring, real_ratio, key)
    real = np.asarray(batches.reward) == 1.0
    assert set(np.unique(batches.reward)) <= {1.0, 2.0}
    assert scipy.stats.binomtest(int(real.sum()), real.size, real_ratio).pvalue > 1e-3
    if 0 < real_ratio < 1:
        # The number of real rows varies from batch to batch as a binomial does.
        expected = 500 * real_ratio * (1 - real_ratio)
        assert real.sum(axis=1).var() == pytest.approx(expected, rel=0.8)
