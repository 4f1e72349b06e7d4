"""The whole run on disk, through orbax: a resumed run is the run."""

import json
import logging
import os
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import type_handlers

from vecpsmbpo import atomic, orbax_words, placement, processes, recorded, shortages
from vecpsmbpo.algorithms import TABLE
from vecpsmbpo.layout import Layout
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.types import TrainState

_log = logging.getLogger(__name__)
FOLDER = "checkpoints"  # in the run directory
IN_FLIGHT_GB = 0.2  # being written or read at a time
CHUNK_BYTES = 32 * 2**20  # of one file

orbax_words.silence()


class Saved(NamedTuple):
    """What a checkpoint gives back."""

    step: int
    state: TrainState
    host: dict[str, Any]


class Checkpoints:
    """Checkpoints of one run, by environment steps.

    Saving is atomic (orbax writes beside and renames) and synchronous: the next chunk is given these very buffers to
    overwrite. Rings are not copied to be saved: orbax is handed views of them, and writes few of them at a time.

    A checkpoint holds the settings that it was made with, and checksums of all that it holds; older ones, which do not,
    are read as they are.
    """

    def __init__(self, directory: Path, settings: Settings, *, keep: int | None = None, read_only: bool = False):
        """
        Args:
            settings: that the run is gone on with, or read.
            keep: how many of the newest stay; None: all.
        """
        self._directory, self._settings = directory, settings
        self._format = TABLE[settings.algo].format
        self._damaged: list[int] = []
        self._to_train = not read_only
        read_only = read_only or not processes.is_first()
        several = processes.are_several()
        if several and not read_only:
            directory.mkdir(exist_ok=True)  # which orbax does for one process only
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep,
            create=not several,
            enable_async_checkpointing=False,
            multiprocessing_options=_alone(),
            cleanup_tmp_directories=not read_only,  # of a save that was killed
            read_only=read_only,
        )
        # Measured on 1 GiB of rings: orbax's defaults take 1.9 GiB beside them, these settings 0.1.
        arrays = type_handlers.NumpyHandler(deepcopy_host_arrays=False)
        in_flight: Any = IN_FLIGHT_GB  # typed as int, meant as a number
        state_handler = ocp.PyTreeCheckpointHandler(
            save_concurrent_gb=in_flight,
            restore_concurrent_gb=in_flight,
            use_ocdbt=False,
            type_handler_registry=type_handlers.create_type_handler_registry((np.ndarray, arrays)),
        )
        handlers = {"state": state_handler, "host": ocp.JsonCheckpointHandler()}
        self._manager = ocp.CheckpointManager(directory.absolute(), options=options, item_handlers=handlers)

    def steps(self) -> list[int]:
        """Steps at which there is a checkpoint, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, state: TrainState, host: dict[str, Any], layout: Layout) -> None:
        """Saves the train state, and what the host knows beside it in JSON's types. All processes of a run call it, and
        the first one writes.

        Checkpoints that `restore` found damaged make room first: the run has gone on from an older one.
        """
        plain = _to_host(state, layout)
        with processes.together():
            if processes.is_first():
                self._write(step, plain, host)

    def _write(self, step: int, plain: dict[str, Any], host: dict[str, Any]) -> None:
        while self._damaged:
            self._manager.delete(self._damaged.pop())
        chunks = jax.tree.map(lambda _: ocp.SaveArgs(chunk_byte_size=CHUNK_BYTES), plain)
        about = {
            "format": self._format,
            "settings": recorded.plain(self._settings),
            "arrays": _arrays_sum(plain),
        }
        known = ocp.args.JsonSave(_summed({**host, **about}))
        items = ocp.args.Composite(state=ocp.args.PyTreeSave(plain, save_args=chunks), host=known)
        self._manager.save(step, args=items, force=True)
        self._manager.wait_until_finished()

    def amend(self, step: int, host: dict[str, Any]) -> None:
        """Says of the checkpoint at `step` what the host has come to know since it was saved. All processes of a run
        call it, and the first one writes."""
        with processes.together():
            if processes.is_first():
                path = self._directory / str(step) / "host" / "metadata"
                stored = json.loads(path.read_text())
                del stored["sum"]
                atomic.write_text(path, json.dumps(_summed({**stored, **host})))

    def restore(
        self, shapes: TrainState, layout: Layout, warn: Callable[[str], None], at: int | None = None
    ) -> Saved | None:
        """The newest checkpoint that can be read, laid out on the mesh; None where there is none at all.

        Damaged ones are warned of, where there is another before them. Nothing is removed.

        Args:
            shapes: of the train state, as `jax.eval_shape` of its initialisation gives them.
            at: only the checkpoint of this step.

        Raises:
            SettingError: there are checkpoints, and none can be read; or they are of other settings, or of an older
                version of this program.
            OSError: the system does not let it be read (`shortages`), which says nothing of what it holds.
        """
        reason: Exception | None = None
        damaged: list[int] = []
        for step in reversed(self.steps()):
            if at not in (None, step):
                continue
            try:
                items = self._read(step, shapes, layout)
            except SettingError:
                raise
            except Exception as error:  # whatever a damaged file makes orbax raise
                if (number := shortages.number_of(error)) in shortages.NOT_READ:  # it may be whole all the same
                    raise OSError(number, os.strerror(number), str(self._directory / str(step))) from error
                _log.debug("checkpoint %d", step, exc_info=error)
                reason = error
                damaged.append(step)
            else:
                for passed_over in damaged:
                    warn(f"the checkpoint at step {passed_over} is damaged; taking the one before it")
                self._damaged += damaged
                return Saved(step, _from_host(items["state"], shapes, layout), items["host"])
        if reason is not None:
            what = (str(reason).strip() or repr(reason)).splitlines()[0][:200]
            which = "holds checkpoints, but none that can be read" if at is None else f"cannot be read at step {at}"
            raise SettingError(f"{self._directory}: {which} ({what})")
        return None

    def _read(self, step: int, shapes: TrainState, layout: Layout) -> Any:
        host = self._manager.restore(step, args=ocp.args.Composite(host=ocp.args.JsonRestore()))["host"]
        if host.pop("sum", None) not in (None, _sum(host)):
            raise ValueError("its checksum is wrong")
        if host.get("format") != self._format:
            raise SettingError(f"{self._directory}: is of another version of this program and cannot be resumed")
        recorded.check(self._settings, host.get("settings", {}))
        if self._to_train:
            recorded.check_retired(self._settings, host.get("settings", {}))
        plain = _shapes_on_host(shapes, layout)
        as_array = jax.tree.map(lambda x: ocp.ArrayRestoreArgs(restore_type=np.ndarray), plain)
        state = ocp.args.PyTreeRestore(plain, restore_args=as_array)
        found = self._manager.restore(step, args=ocp.args.Composite(state=state))["state"]
        if host.get("arrays") not in (None, _arrays_sum(found)):
            raise ValueError("a checksum of its arrays is wrong")
        return {"state": found, "host": host}

    def close(self) -> None:
        self._manager.close()


def _alone() -> Any:
    """Where there are several processes: what one of them reads or writes is no business of the others."""
    if not processes.are_several():
        return ocp.options.MultiprocessingOptions()
    index = jax.process_index()
    return ocp.options.MultiprocessingOptions(index, {index}, barrier_sync_key_prefix=f"process{index}")


def _summed(host: dict[str, Any]) -> dict[str, Any]:
    """With its checksum, as it will be read."""
    host = json.loads(json.dumps(host))
    return {**host, "sum": _sum(host)}


def _sum(host: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(host, sort_keys=True).encode())


def _arrays_sum(plain: dict[str, Any]) -> int:
    """Of arrays on the host, in their order; a gigabyte a second and core."""
    with ThreadPoolExecutor() as pool:
        sums = pool.map(lambda x: zlib.crc32(np.ascontiguousarray(x).data), jax.tree.leaves(plain))
        return zlib.crc32(np.array(list(sums), np.uint32).data)


# ── a train state as a checkpoint holds it: NumPy arrays, without padding, each ring by itself ────────────────────


def _to_host(state: TrainState, layout: Layout) -> dict[str, Any]:
    """All processes of a run call it; it is the same in each."""
    unpadded = placement.unpad(layout, processes.here(state.without_rings()))
    rest = jax.tree.map(lambda x: np.asarray(_storable(x)), unpadded)
    rings = {name: placement.rings_to_host(layout, ring) for name, ring in state.seeds.rings().items()}
    return {"rest": rest, **rings}


def _shapes_on_host(shapes: TrainState, layout: Layout) -> dict[str, Any]:
    """What `_to_host` gives, as shapes."""

    counts = {"real": layout.num_lanes, "imagined": layout.num_lanes * layout.n_members}
    rings = {
        name: [jax.ShapeDtypeStruct(ring.shape[-2:], ring.dtype)] * counts[name]
        for name, ring in shapes.seeds.rings().items()
    }
    rest = jax.eval_shape(lambda state: jax.tree.map(_storable, placement.unpad(layout, state)), shapes.without_rings())
    return {"rest": rest, **rings}


def _from_host(plain: dict[str, Any], shapes: TrainState, layout: Layout) -> TrainState:
    """The inverse of `_to_host`; takes the rings out of `plain`."""
    rest_shapes = jax.eval_shape(partial(placement.unpad, layout), shapes.without_rings())
    state = placement.place(layout, jax.tree.map(_restored, plain["rest"], rest_shapes))
    specs = layout.specs().seeds
    rings = {
        name: placement.rings_from_host(layout, plain[name], ring, getattr(specs, name))
        for name, ring in shapes.seeds.rings().items()
    }
    return state.replace(seeds=state.seeds.replace(**rings))


def _is_key(x: Any) -> bool:
    return jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _storable(x: Any) -> Any:
    """`x` as orbax can store it: keys as numbers; arrays without elements, which it refuses, as one zero."""
    if _is_key(x):
        return jax.random.key_data(x)
    return x if x.size else jnp.zeros(1, x.dtype)


def _restored(x: Any, like: Any) -> Any:
    """The inverse of `_storable`."""
    if _is_key(like):
        return jax.random.wrap_key_data(x)
    return x if like.size else jnp.zeros(like.shape, like.dtype)
