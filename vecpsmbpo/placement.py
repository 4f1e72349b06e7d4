"""A train state between host and mesh: without the mesh's padding, as checkpoints and logs have it, and laid out again.

A checkpoint of one mesh is therefore resumed on any other.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from vecpsmbpo import processes
from vecpsmbpo.layout import BY_MEMBER, BY_SEED, MEMBERS, SEEDS, SHARED, Layout
from vecpsmbpo.types import TrainState


def unpad(layout: Layout, state: TrainState) -> TrainState:
    """`state` without the padding members and models: what a checkpoint holds, whatever mesh it came from."""
    return _rearranged(state, np.arange(layout.n_models), layout.places_of_members)


def place(layout: Layout, state: TrainState) -> TrainState:
    """An unpadded state, padded to this mesh and laid out on it."""
    # Padding repeats what there is: any valid numbers do.
    models = np.arange(layout.padded_models) % layout.n_models
    padded = _rearranged(state, models, layout.members_at_places() % layout.n_members)
    shardings = layout.shardings(padded)
    return jax.device_put(processes.everywhere(padded, shardings), shardings)


def _rearranged(state: TrainState, models: np.ndarray, members: np.ndarray) -> TrainState:
    """`state` with these of its models and these of its members."""
    seeds = state.seeds

    def chosen(tree: Any, which: np.ndarray) -> Any:
        return jax.tree.map(lambda x: x if x.shape[1] == len(which) else x[:, which], tree)

    return state.replace(
        seeds=seeds.replace(
            models=chosen(seeds.models, models),
            agents=chosen(seeds.agents, members),
            imagined=chosen(seeds.imagined, members),
        )
    )


# ── rings on the host: gigabytes at the paper's size, which must not be copied to be saved ──


def rings_to_host(layout: Layout, rings: jax.Array) -> list[np.ndarray]:
    """Each ring [C, F] of [S, C, F], or of the N·M members in [S, P, C, F], by itself.

    Views, where the host's memory is the device's. Of a run over several processes the first one gets them, and the
    others nothing.
    """
    members = [layout.places_of_members.tolist()] if rings.ndim == 4 else []
    wanted = itertools.product(range(layout.num_lanes), *members)
    if not rings.is_fully_addressable:
        return _from_other_processes(layout, rings, list(wanted))
    by_place: dict[tuple[int, ...], np.ndarray] = {}
    for shard in rings.addressable_shards:
        part = _view(shard.data)
        where: Any = shard.index
        for inside, place in zip(np.ndindex(part.shape[:-2]), _places(where[:-2], rings.shape), strict=True):
            by_place[place] = part[inside]
    return [by_place[place] for place in wanted]


def _from_other_processes(layout: Layout, rings: jax.Array, places: list[tuple[int, ...]]) -> list[np.ndarray]:
    """One ring after the other, so that no device ever holds more than one that is not its own."""
    axes, spec = ((SEEDS, MEMBERS), BY_MEMBER) if rings.ndim == 4 else ((SEEDS,), BY_SEED)

    def pick(rings: jax.Array, *place: jax.Array) -> jax.Array:
        inside, ring = jnp.bool_(True), rings
        for index, axis in zip(place, axes, strict=True):
            size = ring.shape[0]
            own = index - jax.lax.axis_index(axis) * size
            inside &= (own >= 0) & (own < size)
            ring = jax.lax.dynamic_index_in_dim(ring, jnp.clip(own, 0, size - 1), keepdims=False)
        # As bits: a sum of numbers would make +0 of -0.
        return jax.lax.psum(jnp.where(inside, jax.lax.bitcast_convert_type(ring, jnp.int32), 0), axes)

    program = layout.jit_shard_map(pick, (spec, *(SHARED,) * len(axes)), SHARED)
    found = []
    for place in places:
        ring = processes.here(program(rings, *layout.everywhere(tuple(map(jnp.int32, place)), SHARED)))
        if processes.is_first():
            found.append(ring.view(np.float32))
    return found


def rings_from_host(layout: Layout, saved: list[Any], like: Any, spec: PartitionSpec) -> jax.Array:
    """The inverse of `rings_to_host`, laid out on the mesh; padding members get empty rings.

    Takes the rings out of `saved` one by one, so that they are never held twice.

    Args:
        like: shape and type of the result.
        spec: how it lies on the mesh.
    """
    of_members = len(like.shape) == 4
    owners = layout.members_at_places().tolist()

    def number(place: tuple[int, ...]) -> int | None:
        """Which of `saved` lies at a place."""
        if not of_members:
            return place[0]
        seed, member = place[0], owners[place[1]]
        return seed * layout.n_members + member if member < layout.n_members else None

    sharding = NamedSharding(layout.mesh, spec)
    replicas: dict[tuple[tuple[int, ...], ...], list[Any]] = {}
    whole: Any = sharding.addressable_devices_indices_map(like.shape)
    for device, where in whole.items():
        replicas.setdefault(tuple(_places(where[:-2], like.shape)), []).append(device)
    parts = []
    for places, devices in replicas.items():
        part = np.zeros((len(places), *like.shape[-2:]), like.dtype)
        for row, place in zip(part, places, strict=True):
            if (index := number(place)) is not None:
                assert saved[index] is not None, "devices come in the order of their places"
                row[:] = saved[index]
                if not of_members or (place[1] + 1) % layout.copies == 0:  # the last that shares it
                    saved[index] = None
        part = part.reshape(sharding.shard_shape(like.shape))
        parts += [jax.device_put(part, device) for device in devices]
    return jax.make_array_from_single_device_arrays(like.shape, sharding, parts)


def _view(x: Any) -> np.ndarray:
    """`x` on the host, and not copied if it is there already.

    `np.asarray` would not copy either, but jax keeps its view as long as `x` lives: a program that is then given `x`
    to overwrite copies it first.
    """
    return np.from_dlpack(x) if x.device.platform == "cpu" else np.asarray(x)


def _places(where: tuple[slice, ...], shape: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """The indices that the slices `where` of an array of this shape hold, in order."""
    return itertools.product(*(range(*piece.indices(size)) for piece, size in zip(where, shape, strict=False)))
