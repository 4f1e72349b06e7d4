"""One run over several processes, on one machine or on many: jax's distributed runtime, and what has to be agreed on.

Every process runs this whole program, and the mesh of `layout` spans devices of all of them. What the host decides must
be the same in all, so it is made of what all of them see, or asked of all: how long a chunk is, whether a signal that
one of them was sent stops the run, whether something failed in one. Simulators of the host are stepped by every process
alike. Only the first process writes. With one process nothing here does anything.
"""

import contextlib
import functools
import re
import socket
import threading
import zlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vecpsmbpo import crash, recorded, versions, words
from vecpsmbpo.settings import SettingError, Settings

PATIENCE_S = 300  # for the other processes to come
SILENCE_S = 1.0  # of that time, before it is said
LOST_AFTER_S = 30  # without a sign of life, a process counts as lost
# How collectives say that a peer has gone.
_GONE = re.compile("gloo|nccl|connection (reset|closed|refused)|unavailable|heartbeat|coordination", re.IGNORECASE)


class LostProcess(Exception):
    """Another process of the run is gone, or has failed; the last checkpoint is whole."""


class NotTogether(SettingError):
    """The other processes have not come. A thread goes on waiting for them, and ends only with this process."""


# ── coming together ──────────────────────────────────────────────────────────────────────────────────────────────


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
    jax.config.update("jax_enable_preemption_service", False)  # SIGTERM is ours (`stopping`)
    crash.doing(f"joining the run{crash.BESIDE_OTHERS}")
    try:
        _initialize(distributed, where)
    except (RuntimeError, ValueError) as error:
        with contextlib.suppress(RuntimeError):
            jax.distributed.shutdown()
        if distributed == "auto" and "coordinator_address" in str(error):
            raise SettingError(
                "distributed=auto: jax finds no cluster here (Slurm, Open MPI, Kubernetes, a TPU's pod); give "
                "distributed=host:port/index/processes"
            ) from None
        raise SettingError(f"distributed={distributed}: {words.of(error)}") from None
    crash.doing("starting")


def _initialize(distributed: str, where: dict[str, Any]) -> None:
    """Comes back when all processes are there.

    jax waits on a thread: where it waits no signal is heeded, and where its own patience is at an end it ends the
    process with a page of C++. So it is given more than there will ever be.

    Raises:
        NotTogether: they are not, after `PATIENCE_S`.
        RuntimeError, ValueError: what jax raises.
    """
    failed: list[Exception] = []

    def wait() -> None:
        try:
            jax.distributed.initialize(
                **where,
                initialization_timeout=1000 * PATIENCE_S,
                heartbeat_timeout_seconds=LOST_AFTER_S,
                shutdown_timeout_seconds=LOST_AFTER_S,
            )
        except Exception as error:
            failed.append(error)

    waiting = threading.Thread(target=wait, daemon=True)
    waiting.start()
    waiting.join(SILENCE_S)
    if waiting.is_alive():
        address = str(where.get("coordinator_address"))
        at = f", of which process 0 is to answer at {address}," if where.get("process_id") else ""
        words.complain(f"waiting for the other processes of the run{at} for up to {PATIENCE_S} s …")
        waiting.join(PATIENCE_S - SILENCE_S)
        if waiting.is_alive():
            what = f"nobody answers at {address}" if at and not _answers(address) else "the others have not all come"
            raise NotTogether(f"distributed={distributed}: {what}, after {PATIENCE_S} s")
    if failed:
        raise failed[0]


def _answers(address: str) -> bool:
    """Whether somebody listens at `host:port`."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=1).close()
    except OSError:
        return False
    return True


def _address(distributed: str) -> dict[str, Any]:
    found = re.fullmatch(r"([^/]+:\d+)/(\d+)/(\d+)", distributed, re.ASCII)
    if not found or int(found[2]) >= int(found[3]) or not 0 < int(found[1].rpartition(":")[2]) < 2**16:
        raise SettingError(
            f"distributed={distributed}: must be auto, or host:port/index/processes with index from 0 to processes - 1"
        )
    return {"coordinator_address": found[1], "process_id": int(found[2]), "num_processes": int(found[3])}


def check_same(settings: Settings) -> None:
    """That all processes were started alike.

    Raises:
        SettingError: they were not.
    """
    if not are_several():
        return
    plain = {**recorded.plain(settings), "distributed": "", **versions.current()}
    if not agree(zlib.crc32(repr(plain).encode()) & 0x7FFFFFFF):
        raise SettingError("distributed: the processes were not given the same settings, or are of different versions")


def of_all(devices: list[Any], count: int) -> list[Any]:
    """`count` of the devices, as many of each process as of the others: neighbours are of one process.

    Raises:
        SettingError: there are more processes than that, and one without a device would have nothing to run.
    """
    several = jax.process_count()
    if count < several:
        raise SettingError(
            f"distributed: there are {several} processes, but so many seeds and members (and devices=) can use only "
            f"{count} device(s); start fewer"
        )
    chosen = []
    for process in range(several):
        own = [device for device in devices if device.process_index == process]
        share = count // several + (process < count % several)
        if share > len(own):
            raise SettingError(f"distributed: process {process} has {len(own)} device(s), but {share} of it are needed")
        chosen += own[:share]
    return chosen


def are_several() -> bool:
    """Whether this is one of several processes. Asks for no device where nothing was joined: there may be none."""
    return jax.distributed.is_initialized() and jax.process_count() > 1


def is_first() -> bool:
    """Whether this process is the one that writes."""
    return jax.process_index() == 0


# ── between the mesh and this process ────────────────────────────────────────────────────────────────────────────


def here(tree: Any) -> Any:
    """What lies on the mesh, so that this process can read all of it. All processes call it."""
    return jax.tree.map(_here, tree) if are_several() else tree


def _here(x: Any) -> Any:
    if not isinstance(x, jax.Array) or x.is_fully_addressable:
        return x
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_here(jax.random.key_data(x)), impl=jax.random.key_impl(x))
    if not x.is_fully_replicated:
        assert isinstance(x.sharding, NamedSharding)
        x = _replicating(x.sharding.mesh)(x)
    return np.asarray(x.addressable_data(0))


@functools.cache
def _replicating(mesh: Any) -> Any:
    return jax.jit(lambda x: x, out_shardings=NamedSharding(mesh, PartitionSpec()))


def everywhere(tree: Any, shardings: Any) -> Any:
    """The inverse of `here`: laid out on the mesh. Every process has all of it, and the same."""
    return jax.tree.map(_everywhere, tree, shardings) if are_several() else tree


def _everywhere(x: Any, sharding: NamedSharding) -> jax.Array:
    if isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_everywhere(jax.random.key_data(x), sharding), impl=jax.random.key_impl(x))
    whole = np.asarray(x)
    return jax.make_array_from_callback(whole.shape, sharding, lambda index: whole[index])


# ── agreeing ─────────────────────────────────────────────────────────────────────────────────────────────────────


def of_first(number: int) -> int:
    """What the first process has."""
    return int(_of_each(number)[0])


def greatest(number: int) -> int:
    """The greatest that any process has. Also a meeting: nobody goes on before all have come here."""
    return int(_of_each(number).max())


def agree(number: int) -> bool:
    """Whether all processes have the same."""
    return bool((_of_each(number) == number).all())


def _of_each(number: int) -> np.ndarray:
    """What each process has, by index."""
    if not are_several():
        return np.array([number])
    mesh = _one_device_each()
    mine = jax.device_put(np.array([number], np.int32), mesh.local_devices[0])
    shape, sharding = (jax.process_count(),), NamedSharding(mesh, PartitionSpec("processes"))
    return _here(jax.make_array_from_single_device_arrays(shape, sharding, [mine]))


@functools.cache
def _one_device_each() -> Mesh:
    firsts = {device.process_index: device for device in reversed(jax.devices())}
    return Mesh(np.array([firsts[process] for process in range(jax.process_count())]), ("processes",))


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Around what may fail in one process alone, and in which none waits for another: then it fails in all.

    Raises:
        LostProcess: it has failed in another process, which says what.
    """
    if not are_several():
        yield
        return
    failed: Exception | None = None
    try:
        yield
    except Exception as error:
        failed = error
    if greatest(int(failed is not None)) and failed is None:
        raise LostProcess("another process of the run has failed, and says why")
    if failed is not None:
        raise failed


@contextlib.contextmanager
def noticing_the_lost() -> Iterator[None]:
    """Around all that waits for other processes.

    Raises:
        LostProcess: one of them is gone.
        SettingError: the task's own code computes on one of them.
    """
    try:
        yield
    except (jax.errors.JaxRuntimeError, ValueError) as error:  # the latter from compiled functions called by Python
        if not are_several() or not _GONE.search(str(error)):
            raise
        why = str(error).strip().splitlines()[0][:200]
        again = "the last checkpoint is whole; to go on, give the same command again, in all of them"
        raise LostProcess(f"another process of the run is gone ({why}); {again}") from None
    except RuntimeError as error:
        if not are_several() or "non-addressable" not in str(error):
            raise
        raise SettingError(
            "distributed: the task keeps arrays on a device of another process (of jax.devices(), and not of "
            "jax.local_devices()), so that it can be trained in one process only"
        ) from None
