"""Where seeds, models and members lie on devices, and how devices talk. (What goes from there to the host and back:
`placement`.)

The devices form a mesh of two axes, `seeds` × `members`. Seeds never talk to one another. Members of a seed are
spread over the second axis, rounded up to it; the real data, the environment and the posterior are replicated along
it, and the few values that cross it (the acting policy's action, the models) are collectives below. A laptop's two
cores, one GPU and eight GPUs are the same program on a different mesh.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vecpsmbpo import empty_arrays, mesh, processes
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import SeedState, TrainState

SEEDS, MEMBERS = "seeds", "members"
SHARED, BY_SEED, BY_MEMBER = PartitionSpec(), PartitionSpec(SEEDS), PartitionSpec(SEEDS, MEMBERS)
LARGE = 16384  # elements of a leaf (a hidden layer of 128 by 128) from which on a collective of its own is cheaper


@dataclass(frozen=True)
class Layout:
    """How S seeds of N models and N·M members lie on a mesh.

    Attributes:
        mesh: of devices, axes `seeds` × `members`.
        num_lanes: S.
        n_models: N.
        n_policies: M.
        n_members: N·M, or M where policies do not belong to models.
        sequential: members of one device, of one seed and of all, run one after the other instead of batched. On a CPU
            core, whose cache holds one member's parameters but not all of them, this is faster; the arithmetic is the
            same.
        copies: how many devices share a member, where there are more devices than members: each holds all of it, draws
            the same minibatches, and computes the gradients of its part of their rows.
    """

    mesh: Mesh
    num_lanes: int
    n_models: int
    n_policies: int
    n_members: int
    sequential: bool
    copies: int = 1

    @classmethod
    def of(cls, settings: Settings) -> "Layout":
        """Uses the devices of the process that can be given work, of the first `settings.devices`."""
        devices = jax.devices()
        most = min(settings.devices or len(devices), len(devices))
        on_cpu = devices[0].platform == "cpu"
        copies = partial(mesh.copies, settings.n_members, settings.minibatch if on_cpu else 1)
        shape = mesh.shape(len(settings.lanes), settings.n_models, settings.n_members, most, copies)
        grid = np.array(processes.of_all(devices, math.prod(shape))).reshape(shape)
        return cls(
            mesh=Mesh(grid, (SEEDS, MEMBERS)),
            num_lanes=len(settings.lanes),
            n_models=settings.n_models,
            n_policies=settings.policies_per_model,
            n_members=settings.n_members,
            sequential=on_cpu,
            copies=copies(shape[1]),
        )

    # how many there are

    @property
    def shards(self) -> int:
        """Devices along the member axis."""
        return self.mesh.shape[MEMBERS]

    @property
    def padded_models(self) -> int:
        return -(-self.n_models // self.shards) * self.shards

    @property
    def padded_members(self) -> int:
        """P. Members from N·M on fill the mesh; the posterior never draws them and no file shows them. Where devices
        share members, each place counts: P = N·M · copies."""
        return -(-self.n_members * self.copies // self.shards) * self.shards

    # inside the program, for one seed on one device

    def model_ids(self) -> jax.Array:
        """Indices of this device's models."""
        local = self.padded_models // self.shards
        return jax.lax.axis_index(MEMBERS) * local + jnp.arange(local)

    def member_ids(self) -> jax.Array:
        """Indices n·M + m of this device's members."""
        local = self.padded_members // self.shards
        return (jax.lax.axis_index(MEMBERS) * local + jnp.arange(local)) // self.copies

    def model_of(self, member: jax.Array) -> jax.Array:
        """n of member n·M + m; padding members share the last model."""
        return jnp.minimum(member // self.n_policies, self.n_models - 1)

    def keys(self, key: jax.Array, ids: jax.Array) -> jax.Array:
        """A key per model or member that depends on its index and not on the mesh."""
        return jax.vmap(partial(jax.random.fold_in, key))(ids)

    def map_local(self, function: Callable, *batched: Any, shared: tuple = ()) -> Any:
        """`function` of (what one model or member has, ..., *shared), applied to each of this device's.

        Where they run one after the other, so do the seeds that this is then batched over: XLA adds along the rows of
        [256, 64] four times as fast as along those of [1, 256, 64], and a fit that has stopped need not wait for the
        fits of other seeds. All of them in one loop: of two, one in the other, each would take every leaf apart and put
        it together again, a sixth of what XLA has to compile. (One level of batching: another around it is `vmap`.)

        Args:
            batched: leaves [N_local, ...] or [P_local, ...].
            shared: what `function` needs of the state otherwise; it must not close over any of it.
        """
        if not self.sequential:
            return jax.vmap(lambda *one: function(*one, *shared))(*batched)

        @jax.custom_batching.custom_vmap
        def loop(batched: Any, shared: Any) -> Any:
            return jax.lax.map(lambda one: function(*one, *shared), batched)

        @loop.def_vmap
        def loop_over_seeds(seeds: int, by_seed: Any, batched: Any, shared: Any) -> Any:
            """Leaves of `batched` [S, P_local, ...], and of `shared` [S, ...], but for those that all seeds share."""

            def of_seeds(x: jax.Array, differs: bool) -> jax.Array:
                return x if differs else jnp.broadcast_to(x, (seeds, *x.shape))

            batched = jax.tree.map(of_seeds, batched, by_seed[0])
            members = jax.tree.leaves(batched)[0].shape[1]

            def run(index: jax.Array, one: Any) -> Any:
                seed = index // members if seeds > 1 else 0  # of one seed nothing is copied
                return function(*one, *jax.tree.map(lambda x, differs: x[seed] if differs else x, shared, by_seed[1]))

            flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batched)
            found = jax.lax.map(lambda xs: run(*xs), (jnp.arange(seeds * members), flat))
            found = jax.tree.map(lambda x: x.reshape(seeds, members, *x.shape[1:]), found)
            return found, jax.tree.map(lambda _: True, found)

        return loop(batched, shared)

    def models_of_members(self, models: Any) -> Any:
        """This device's models [N_local, ...] -> for each of its members the model that it learns in [P_local, ...]."""
        chosen = self.model_of(self.member_ids())
        return jax.tree.map(lambda x: _gathered(x)[chosen], models)

    def all_models(self, models: Any) -> Any:
        """This device's models [N_local, ...] -> all of them, [N, ...]."""
        return jax.tree.map(lambda x: _gathered(x)[: self.n_models], models)

    def all_members(self, values: jax.Array) -> jax.Array:
        """What this device's members have, [P_local, ...] -> what all have, [N·M, ...]."""
        return _gathered(values)[:: self.copies][: self.n_members]

    def all_models_for_members(self, models: Any) -> Any:
        """This device's models [N_local, ...] -> all N of them for each of its members, [P_local, N, ...]."""
        members = self.member_ids().shape[0]
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *x.shape)), self.all_models(models))

    def map_sharded(self, function: Callable[[jax.Array, jax.Array], jax.Array], items: jax.Array) -> jax.Array:
        """`function` of (items [K', ...], their indices [K']) -> [K'], each device doing its part of the K: [K].

        The same `items` are on every device, and so is the answer.
        """
        count = items.shape[0]
        local = -(-count // self.shards)
        ids = jnp.minimum(jax.lax.axis_index(MEMBERS) * local + jnp.arange(local), count - 1)
        return _gathered(function(items[ids], ids))[:count]

    def select_member(self, member: jax.Array, tree: Any, function: Callable = lambda params: params) -> Any:
        """`function` of the leaves [...] that `member` has in `tree` [P_local, ...]: computed by every device for one
        of its own members, taken from the device where `member` lives."""
        local = self.padded_members // self.shards
        index = member * self.copies - jax.lax.axis_index(MEMBERS) * local
        here = (index >= 0) & (index < local)
        index = jnp.clip(index, 0, local - 1)
        answer = function(jax.tree.map(lambda x: jax.lax.dynamic_index_in_dim(x, index, keepdims=False), tree))
        masked = jax.tree.map(lambda x: jnp.where(here, x, jnp.zeros_like(x)), answer)
        return jax.lax.psum(masked, MEMBERS)

    def mean_over_members(self, values: jax.Array) -> jax.Array:
        """[P_local, ...] -> the mean over the N·M members, [...]."""
        real = self.member_ids() < self.n_members
        kept = jnp.where(real.reshape(-1, *(1,) * (values.ndim - 1)), values, 0.0)
        return jax.lax.psum(jnp.sum(kept, axis=0), MEMBERS) / (self.n_members * self.copies)

    def part(self, tree: Any, axis: int) -> Any:
        """This device's part, along `axis`, of what all devices that share a member have of it."""
        if self.copies == 1:
            return tree

        def cut(x: jax.Array) -> jax.Array:
            size = x.shape[axis] // self.copies
            start = jax.lax.axis_index(MEMBERS) % self.copies * size
            return jax.lax.dynamic_slice_in_dim(x, start, size, axis)

        return jax.tree.map(cut, tree)

    def mean_of_parts(self, tree: Any) -> Any:
        """The mean of every leaf over the devices that share a member. Small leaves go as one array, since a collective
        costs what a small matrix product does, whatever it carries. Large ones go by themselves: XLA's CPU code walks
        the whole of a concatenation once for each of its parts, masked, which has cost as much as all products."""
        if self.copies == 1:
            return tree
        groups = np.arange(self.shards).reshape(-1, self.copies).tolist()

        def mean(x: jax.Array) -> jax.Array:
            return jax.lax.pmean(x, MEMBERS, axis_index_groups=groups)

        leaves, structure = jax.tree.flatten(tree)
        flat, unravel = ravel_pytree([leaf for leaf in leaves if leaf.size < LARGE])
        small = iter(unravel(mean(flat)))
        return jax.tree.unflatten(structure, [mean(leaf) if leaf.size >= LARGE else next(small) for leaf in leaves])

    def least_of_members(self, values: jax.Array) -> jax.Array:
        """The smallest [] of what this and the other devices of the seed have."""
        return jax.lax.pmin(values, MEMBERS)

    def any_seed(self, flags: jax.Array) -> jax.Array:
        """[S_local] bool -> whether any seed, on any device, has it."""
        return jax.lax.pmax(jnp.any(flags).astype(jnp.int32), SEEDS) > 0

    # around the program

    def specs(self) -> TrainState:
        """Where every part of a train state lies: a prefix of its tree."""
        parts: dict[str, Any] = dict.fromkeys(SeedState.__dataclass_fields__, BY_SEED)
        parts.update(models=BY_MEMBER, agents=BY_MEMBER, imagined=BY_MEMBER)
        shared: Any = SHARED
        return TrainState(counters=shared, seeds=SeedState(**parts), env=BY_SEED)

    def jit_shard_map(self, function: Callable, in_specs: Any, out_specs: Any, **jit: Any) -> Any:
        """`function` of a device's part, jitted over the whole mesh."""
        # Replication along `members` holds by construction (equal inputs, equal programs); jax's static check of it
        # cannot follow MJX's while loops.
        body = empty_arrays.made_inside(function)
        body = jax.shard_map(body, mesh=self.mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
        # Shardings are stated, not inferred, so that a fresh and a resumed run are one program to the cache.
        return jax.jit(body, in_shardings=self._placed(in_specs), out_shardings=self._placed(out_specs), **jit)

    def everywhere(self, tree: Any, spec: PartitionSpec) -> Any:
        """What every process of the run has, as arguments of `jit_shard_map`: all leaves lie as `spec` says."""
        return processes.everywhere(tree, jax.tree.map(lambda _: NamedSharding(self.mesh, spec), tree))

    def _placed(self, specs: Any) -> Any:
        return jax.tree.map(
            lambda spec: NamedSharding(self.mesh, spec), specs, is_leaf=lambda x: isinstance(x, PartitionSpec)
        )

    def shardings(self, state: TrainState) -> TrainState:
        """A sharding per leaf of `state` (arrays or shapes)."""
        specs = jax.tree.broadcast(self.specs(), state, is_leaf=lambda x: isinstance(x, PartitionSpec))
        return self._placed(specs)

    @property
    def places_of_members(self) -> np.ndarray:
        """[N·M] where on the axis [P] each member lies, first."""
        return np.arange(self.n_members) * self.copies

    def members_at_places(self) -> np.ndarray:
        """[P] which member lies there; from N·M on, padding."""
        return np.arange(self.padded_members) // self.copies


def _gathered(x: jax.Array) -> jax.Array:
    """[X_local, ...] -> [X, ...] on every device."""
    return jax.lax.all_gather(x, MEMBERS, tiled=True)
