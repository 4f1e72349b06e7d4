"""Batching changes nothing: vmap, loops, one device or two give the same members."""

import dataclasses
import re
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from tests.helpers import algorithm, environment, initial, tiny
from vecpsmbpo import mesh, placement, sac
from vecpsmbpo.envs import specs
from vecpsmbpo.layout import SHARED, Layout
from vecpsmbpo.schedule import over_seeds
from vecpsmbpo.types import Counters, TrainState

SPEC = specs.get("ball_in_cup")


def learned(settings, layout):
    """All seeds after one `learn` on random data; unpadded."""
    learner = dataclasses.replace(algorithm(settings, SPEC), layout=layout)
    specs_ = layout.specs()
    state = initial(learner)
    noise = jax.random.normal(jax.random.key(3), state.real.shape[1:])
    row = jax.random.normal(jax.random.key(4), state.imagined.shape[2:])
    state = state.replace(real=state.real + noise, imagined=state.imagined + row)
    run = layout.jit_shard_map(
        lambda c, s: s.replace(agents=over_seeds(learner.learn)(c, s, s.key)),
        (specs_.counters, specs_.seeds),
        specs_.seeds,
    )
    counters = Counters(jnp.int32(100), jnp.int32(16))
    return placement.unpad(layout, TrainState(counters, run(counters, state), jnp.zeros((1, 1)))).seeds


def _close(a, b, atol=2e-5):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=atol), a, b)


@pytest.fixture(scope="module")
def reference():
    """3 members of 1 seed on one device, one after the other."""
    settings = tiny(n_models=3, n_policies=1, devices=1)
    return settings, learned(settings, Layout.of(settings))


def test_batched_members_equal_members_in_a_loop(reference):
    settings, looped = reference
    layout = Layout.of(settings)
    assert layout.sequential
    batched = learned(settings, dataclasses.replace(layout, sequential=False))
    _close(batched.agents, looped.agents)


def test_members_on_two_devices_equal_members_on_one(reference):
    """Three members on two devices are padded to four; the padding shows nowhere."""
    settings, looped = reference
    layout = Layout.of(dataclasses.replace(settings, devices=2))
    assert dict(layout.mesh.shape) == {"seeds": 1, "members": 2}
    assert layout.padded_members == 4
    _close(learned(settings, layout).agents, looped.agents)


def test_seeds_in_one_program_equal_seeds_alone(reference):
    settings, alone = reference
    both = dataclasses.replace(settings, num_seeds=2, devices=2)
    layout = Layout.of(both)
    assert dict(layout.mesh.shape) == {"seeds": 2, "members": 1}
    together = learned(both, layout)
    _close(jax.tree.map(lambda x: x[:1], together.agents), alone.agents)
    second = dataclasses.replace(settings, seed=settings.seed + 1)
    _close(jax.tree.map(lambda x: x[1:], together.agents), learned(second, Layout.of(second)).agents)


@pytest.mark.parametrize("seeds", [1, 2])
def test_what_runs_in_turns_has_what_is_its_own(seeds):
    """Seeds batched around the loop over members, on one device: each has its own data, or what all of them share."""
    layout = Layout.of(tiny(n_models=3, n_policies=1, devices=1))
    own = jax.random.normal(jax.random.key(0), (seeds, 3, 4))
    keys = jax.random.split(jax.random.key(1), (seeds, 3))
    data, weights, common = jnp.arange(10.0).reshape(2, 5)[:seeds], jnp.arange(3.0), jnp.float32(0.5)

    def function(x, key, weight, data, nothing, common):
        assert nothing is None
        return x * weight + data.sum() + common, jax.random.normal(key)

    def of_seed(x, keys, data):
        return layout.map_local(function, x, keys, weights, shared=(data, None, common))

    assert layout.sequential
    found, drawn = jax.jit(jax.vmap(of_seed))(own, keys, data)
    expected = own * weights[:, None] + data.sum(axis=1)[:, None, None] + common
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    np.testing.assert_array_equal(drawn, jax.vmap(jax.vmap(jax.random.normal))(keys))


def test_a_member_learns_as_a_single_agent_would(reference):
    """The program's member 1 equals `sac.updates` called by hand on the minibatches that it drew."""
    settings, looped = reference
    learner = algorithm(settings, SPEC)
    seeds = initial(learner)
    noise = jax.random.normal(jax.random.key(3), seeds.real.shape[1:])
    row = jax.random.normal(jax.random.key(4), seeds.imagined.shape[2:])
    state = jax.tree.map(lambda x: x[0], seeds.replace(real=seeds.real + noise, imagined=seeds.imagined + row))
    batch_key, update_key = jax.random.split(state.key)
    counters = Counters(jnp.int32(100), jnp.int32(16))
    batches = learner.minibatches(
        counters, state, state.imagined[1], settings.real_ratio, jax.random.fold_in(batch_key, 1)
    )
    agent = jax.tree.map(lambda x: x[1], state.agents)
    nets = sac.make_networks(settings, SPEC)
    shape = (settings.updates_per_step, settings.policy_batch_size, SPEC.action_size)
    drawn = sac.Noise.draw(jax.random.fold_in(update_key, 1), shape)
    single = sac.updates(agent, batches, drawn, state.hyper, nets=nets)
    _close(single, jax.tree.map(lambda x: x[0, 1], looped.agents))


def test_place_is_the_inverse_of_unpad():
    settings = tiny(n_models=3, n_policies=1, devices=2)
    layout = Layout.of(settings)
    learner = algorithm(settings, SPEC)
    counters = Counters(jnp.int32(0), jnp.int32(0))
    state = TrainState(counters, initial(learner), jnp.zeros((1, 2)))
    plain = placement.unpad(layout, state)
    assert plain.seeds.agents.log_alpha.shape == (1, 3)
    again = placement.unpad(layout, placement.place(layout, plain))
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(plain), strict=True):
        if not jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(("seeds", "models"), [(1, 3), (2, 3), (1, 1)])
def test_rings_come_back_from_the_host(seeds, models):
    """Padded members (3 on 2 devices) do not reach the host, a shared one (1 on 2) does once; seeds on 2 devices are
    put together again."""
    settings = tiny(n_models=models, n_policies=1, num_seeds=seeds, devices=2, policy_batch_size=64)
    layout = Layout.of(settings)
    seeds_state = initial(algorithm(settings, SPEC))
    for name, members in (("real", None), ("imagined", models)):
        empty, spec = getattr(seeds_state, name), getattr(layout.specs().seeds, name)
        values = np.random.default_rng(0).normal(size=empty.shape).astype(np.float32)
        rings = placement.rings_to_host(layout, jax.device_put(values, empty.sharding))
        expected = values if members is None else values[:, :members]
        np.testing.assert_array_equal(np.reshape(rings, expected.shape), expected)
        again = placement.rings_from_host(layout, rings, empty, spec)
        assert again.sharding == empty.sharding
        assert rings == [None] * len(rings)
        np.testing.assert_array_equal(again if members is None else again[:, :members], expected)


def test_saving_rings_leaves_them_to_be_overwritten_in_place():
    """A view that outlived the save would make the next donated call copy gigabytes."""
    layout = Layout.of(tiny(devices=2))
    ring = initial(algorithm(tiny(devices=2), SPEC)).imagined
    shards = lambda x: [shard.data.unsafe_buffer_pointer() for shard in x.addressable_shards]  # noqa: E731
    before = shards(ring)
    assert len(placement.rings_to_host(layout, ring)) == 4
    after = jax.jit(lambda x: x.at[..., 0].set(1.0), donate_argnums=0, out_shardings=ring.sharding)(ring)
    assert shards(after) == before


@pytest.mark.parametrize(
    ("lanes", "models", "members", "most", "shape"),
    [
        (1, 3, 3, 2, (1, 2)),
        (2, 3, 3, 2, (2, 1)),
        (3, 1, 1, 2, (1, 1)),  # a second device could only run padding
        (3, 2, 2, 2, (1, 2)),
        (10, 4, 4, 8, (2, 4)),
        (1, 5, 25, 64, (1, 25)),
        (5, 1, 1, 4, (1, 1)),
        (6, 5, 25, 4, (2, 2)),
        (1, 7, 1, 2, (1, 2)),
    ],
)
def test_the_mesh_gives_the_busiest_device_least_to_do(lanes, models, members, most, shape):
    found = mesh.shape(lanes, models, members, most, lambda shards: 1)
    work = lambda s, m: lanes // s * (-(-models // m) + mesh.MEMBER_WORK * -(-members // m))  # noqa: E731
    assert lanes % found[0] == 0
    assert work(*found) == work(*shape)
    assert found[0] * found[1] <= shape[0] * shape[1] <= most


@pytest.mark.parametrize(
    ("lanes", "models", "members", "batch", "most", "shape", "copies"),
    [
        (1, 1, 1, 256, 2, (1, 2), 2),  # MBPO, SAC: both cores learn
        (2, 1, 1, 256, 2, (2, 1), 1),  # a core for each seed needs nothing of the other
        (3, 1, 1, 256, 2, (1, 2), 2),
        (1, 7, 1, 256, 4, (1, 4), 4),
        (1, 1, 1, 255, 2, (1, 1), 1),  # rows that cannot be halved
        (1, 2, 2, 256, 4, (1, 4), 2),
        (1, 2, 2, 256, 3, (1, 2), 1),
        (1, 5, 1, 256, 3, (1, 2), 2),  # two that learn are worth more than three that fit models
        (1, 5, 1, 256, 6, (1, 4), 4),
        (1, 1, 1, 256, 64, (1, 8), 8),
    ],
)
def test_devices_without_a_member_of_their_own_share_one(lanes, models, members, batch, most, shape, copies):
    found = mesh.shape(lanes, models, members, most, partial(mesh.copies, members, batch))
    assert (found, mesh.copies(members, batch, found[1])) == (shape, copies)


def test_a_member_that_devices_share_equals_one_on_one_device():
    """Gradients of the parts of a minibatch, averaged, are those of the minibatch."""
    settings = tiny(n_models=1, n_policies=1, devices=1, policy_batch_size=64)
    alone = learned(settings, Layout.of(settings))
    layout = Layout.of(dataclasses.replace(settings, devices=2))
    assert (layout.copies, layout.padded_members) == (2, 2)
    together = learned(settings, layout)
    _close(together.agents, alone.agents)
    np.testing.assert_array_equal(together.imagined, alone.imagined)


def test_large_leaves_are_averaged_as_they_are():
    """Of 6 and of 16,384 elements, and a scalar, on two devices: what XLA concatenates holds the small ones alone."""
    layout = Layout.of(tiny(n_models=1, n_policies=1, devices=2, policy_batch_size=64))
    assert layout.copies == 2
    parts = {"loss": jnp.arange(2.0), "bias": jnp.arange(12.0).reshape(2, 6), "weights": jnp.ones((2, 128, 128))}
    parts["weights"] = parts["weights"].at[1].set(4.0)
    member = PartitionSpec("members")
    run = layout.jit_shard_map(lambda tree: layout.mean_of_parts(jax.tree.map(lambda x: x[0], tree)), (member,), SHARED)
    found = run(parts)
    assert found["loss"] == 0.5
    np.testing.assert_array_equal(found["bias"], 3.0 + np.arange(6.0))
    np.testing.assert_array_equal(found["weights"], np.full((128, 128), 2.5))
    assert re.findall(r"f32\[(\d+)\][^\n]* concatenate\(", run.lower(parts).compile().as_text()) == ["7"]


EMPTY = """
import sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, PartitionSpec as P
from vecpsmbpo.layout import Layout

jax.config.update("jax_num_cpu_devices", 2)
layout = Layout(Mesh(np.array(jax.devices()).reshape(2, 1), ("seeds", "members")), 2, 1, 1, 1, True)
ours = lambda body, specs: layout.jit_shard_map(body, specs, P("seeds"))
jaxs = lambda body, specs: jax.jit(jax.shard_map(body, mesh=layout.mesh, in_specs=specs, out_specs=P("seeds")))
x, nothing = jnp.arange(4.0), jnp.zeros((4, 0))
cases = {
    "given": (lambda x, y: x + y.sum(), (P("seeds"), P("seeds")), (x, nothing)),
    "captured": (lambda x: x + nothing.sum(), (P("seeds"),), (x,)),
    "in a loop": (lambda x: jax.lax.fori_loop(0, 2, lambda _, x: x + nothing.sum(), x), (P("seeds"),), (x,)),
}
body, specs, args = cases[sys.argv[2]]
np.testing.assert_array_equal({"ours": ours, "jax's": jaxs}[sys.argv[1]](body, specs)(*args), x)
"""


def with_empty_arrays(spread: str, case: str) -> int:
    """The exit status of a program of its own: a crash of the compiler ends the process."""
    program = [sys.executable, "-c", EMPTY, spread, case]
    return subprocess.run(program, env=environment(), capture_output=True, timeout=120).returncode


@pytest.mark.parametrize("case", ["given", "captured", "in a loop"])
def test_arrays_without_elements_may_come_from_outside_of_the_program(case):
    assert with_empty_arrays("ours", case) == 0


@pytest.mark.skipif(jax.__version_info__ < (0, 11), reason="it came with jax 0.11")
def test_jaxs_own_shard_map_still_crashes_on_them():
    """Where this fails, `Layout.jit_shard_map` need no longer make them inside (docs/architecture.md)."""
    assert with_empty_arrays("jax's", "captured") == -11
