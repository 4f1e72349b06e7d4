"""One run over several processes, on one machine or on many: jax's distributed runtime, and what has to be agreed on.

Every process runs this whole program, and the mesh of `layout` spans the devices of all of them. What the host decides
must be the same in all, so it is made of what all of them see, or the first process decides: how long a chunk is, and
whether a signal that one of them was sent stops the run. Simulators of the host are stepped by every process alike.
Only the first process writes. With one process nothing here does anything.
"""

import re
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import NamedSharding, PartitionSpec

from vecpsmbpo import words
from vecpsmbpo.settings import SettingError

LOST_AFTER_S = 30  # without a sign of life, a process counts as lost


class LostProcess(Exception):
    """Another process of the run is gone, and with it a part of the state; the last checkpoint is whole."""


def join(distributed: str) -> None:
    """Becomes one of the processes of a run. Comes before the first array.

    Args:
        distributed: empty, where there is one; `auto`, where jax finds out by itself (Slurm, Open MPI, a TPU's pod); or
            `host:port/index/processes`, with the address at which process 0 can be reached by all.

    Raises:
        SettingError: it is none of these, or the others cannot be reached.
    """
    if not distributed or jax.distributed.is_initialized():
        return
    where = {} if distributed == "auto" else _address(distributed)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            **where, heartbeat_timeout_seconds=LOST_AFTER_S, shutdown_timeout_seconds=LOST_AFTER_S
        )
    except (RuntimeError, ValueError) as error:
        raise SettingError(f"distributed={distributed}: {words.of(error)}") from None


def _address(distributed: str) -> dict[str, Any]:
    found = re.fullmatch(r"([^/]+:\d+)/(\d+)/(\d+)", distributed, re.ASCII)
    if not found or int(found[2]) >= int(found[3]):
        raise SettingError(
            f"distributed={distributed}: must be auto, or host:port/index/processes with index from 0 to processes - 1"
        )
    return {"coordinator_address": found[1], "process_id": int(found[2]), "num_processes": int(found[3])}


def check_all_have_one_of(devices: np.ndarray) -> None:
    """That the mesh has devices of every process: one without any would have nothing to run.

    Raises:
        SettingError: it has not.
    """
    used = {device.process_index for device in devices.flat}
    if len(used) < jax.process_count():
        raise SettingError(
            f"distributed: there are {jax.process_count()} processes, but the devices of {len(used)} are all that so "
            "many seeds and members can use; start fewer"
        )


def is_first() -> bool:
    """Whether this process is the one that writes."""
    return jax.process_index() == 0


def here(tree: Any) -> Any:
    """What lies on the mesh, so that this process can read all of it: NumPy arrays and keys. All processes call it."""
    return tree if jax.process_count() == 1 else jax.tree.map(_here, tree)


def _here(x: Any) -> Any:
    if not isinstance(x, jax.Array) or x.is_fully_addressable:
        return x
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_here(jax.random.key_data(x)), impl=jax.random.key_impl(x))
    if not x.is_fully_replicated:
        x = jax.jit(lambda x: x, out_shardings=NamedSharding(x.sharding.mesh, PartitionSpec()))(x)
    return np.asarray(x.addressable_data(0))


def everywhere(tree: Any, shardings: Any) -> Any:
    """The inverse of `here`: laid out on the mesh. Every process has all of it, and the same."""
    return tree if jax.process_count() == 1 else jax.tree.map(_everywhere, tree, shardings)


def _everywhere(x: Any, sharding: NamedSharding) -> jax.Array:
    if isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_everywhere(jax.random.key_data(x), sharding), impl=jax.random.key_impl(x))
    whole = np.asarray(x)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


def of_first(number: int) -> int:
    """What the first process has."""
    return number if jax.process_count() == 1 else int(multihost_utils.broadcast_one_to_all(np.int32(number)))


def greatest(number: int) -> int:
    """The greatest that any process has."""
    if jax.process_count() == 1:
        return number
    return int(np.max(multihost_utils.process_allgather(np.int32(number))))
