"""The memory that a run will take, before any of it is taken, and the memory that there is."""

import errno
import math
import os
import shutil
from pathlib import Path
from typing import Any

import jax

from vecpsmbpo import limits, processes, replay
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.layout import MEMBERS, SEEDS, Layout
from vecpsmbpo.limits import GIB
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import TrainState

CHECKPOINT_OVERHEAD = 2**20  # orbax's own files
# Python, JAX and what XLA takes to compile and keeps (measured: hopper at the paper's size held 6.7 GiB at most, of
# which 4.2 are announced otherwise; 6.0 where the program came from the compilation cache).
PROGRAM_BYTES = 11 * GIB // 4


def state_bytes(layout: Layout, shapes: Any) -> int:
    """Bytes that a train state of these shapes takes on the whole mesh, replicas included."""
    total = 0
    for leaf, sharding in zip(jax.tree.leaves(shapes), jax.tree.leaves(layout.shardings(shapes)), strict=True):
        split = {axis for part in sharding.spec if part for axis in ((part,) if isinstance(part, str) else part)}
        replicas = math.prod(layout.mesh.shape[axis] for axis in (SEEDS, MEMBERS) if axis not in split)
        size = 8 if jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf.dtype.itemsize
        total += math.prod(leaf.shape) * size * replicas
    return total


def working_bytes(algorithm: Algorithm) -> int:
    """Bytes of the largest temporaries: what the algorithm computes with, on a CPU also the rings of one device, which
    are put together before they are handed to it when a run is resumed."""
    spec, layout = algorithm.spec, algorithm.layout
    row = 4 * replay.row_size(spec.obs_size, spec.action_size)
    members = layout.padded_members * layout.num_lanes
    working = members * algorithm.working_bytes(row)
    if not _on_cpu(layout):
        return working
    rings = members * algorithm.ring_capacity * row
    return max(working, rings // layout.mesh.size)


def available_bytes(layout: Layout) -> int:
    """Free memory for this process's part of the mesh: of the GPUs, or of this machine (and what it lets us have)."""
    if not _on_cpu(layout):
        stats = [device.memory_stats() or {} for device in layout.mesh.local_devices]
        return sum(s.get("bytes_limit", 0) - s.get("bytes_in_use", 0) for s in stats)
    return min(_machine_available(), _control_group_available(), limits.free_address_space())


def _on_cpu(layout: Layout) -> bool:
    return layout.mesh.devices.flat[0].platform == "cpu"


def _machine_available() -> int:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return 2**63  # not Linux: nothing to compare with
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable"))


def _control_group_available() -> int:
    group = Path("/sys/fs/cgroup")
    try:
        limit = (group / "memory.max").read_text().strip()
        used = int((group / "memory.current").read_text())
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except OSError:
        return 2**63
    # What files are cached counts as used, and is given up when it is needed.
    return 2**63 if limit == "max" else int(limit) - used + int(stat.get("inactive_file", 0))


def check_memory(algorithm: Algorithm, shapes: Any) -> str:
    """What the run takes against what there is, in words.

    Args:
        shapes: of the train state.

    Raises:
        SettingError: it does not fit.
    """
    layout = algorithm.layout
    ours = len(layout.mesh.local_devices) / layout.mesh.size  # of several processes, each has its own memory
    state, working = ours * state_bytes(layout, shapes), ours * working_bytes(algorithm)
    working += ours * state_bytes(layout, shapes.without_rings())  # as a stride began, should it have to be undone
    if _on_cpu(layout) and processes.are_several() and processes.is_first():  # it writes the rings of all
        working += sum(ring.size * ring.dtype.itemsize for ring in shapes.seeds.rings().values())
    program = PROGRAM_BYTES if _on_cpu(layout) else 0
    free = available_bytes(layout)
    words = f"{state / GIB:.2f} GiB of buffers and networks, {working / GIB:.2f} GiB at work"
    if program:
        words += f", up to {program / GIB:.2f} GiB for the program itself"
    if state + working + program > free:
        raise SettingError(
            f"not enough memory: {words}, but {free / GIB:.2f} GiB are free; lower imagined_capacity, "
            "replay_capacity, n_models, n_policies, num_seeds or devices"
        )
    return f"{words}, of {free / GIB:.1f} GiB free"


def check_disk(directory: Path, state: TrainState, env_steps: int, layout: Layout) -> None:
    """Whether there is room for a checkpoint at `env_steps`: parameters whole, buffers as far as they are filled then,
    each member once.

    Asked before writing, since orbax's threads report a disk that fills under them in a page of tracebacks.

    Raises:
        OSError: ENOSPC.
    """

    def filled(ring: jax.Array, rows: int) -> int:
        return ring.nbytes * min(rows, ring.shape[-2]) // ring.shape[-2]

    seeds, counters = state.seeds, state.counters
    later = env_steps > int(counters.env_steps)
    of_members = sum(leaf.nbytes for leaf in jax.tree.leaves(seeds.agents))
    if seeds.imagined is not None:
        of_members += filled(seeds.imagined, seeds.imagined.shape[-2] if later else int(counters.imagined_rows))
    needed = CHECKPOINT_OVERHEAD + of_members * layout.n_members // layout.padded_members
    needed += filled(seeds.real, env_steps) + sum(leaf.nbytes for leaf in jax.tree.leaves(seeds.models))
    if shutil.disk_usage(directory).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
