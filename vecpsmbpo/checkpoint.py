"""The whole run on disk, through orbax: a resumed run is the run."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from vecpsmbpo.layout import Layout
from vecpsmbpo.types import TrainState

_log = logging.getLogger(__name__)
KEPT = 2  # the newest and the one before it, should the newest be damaged


class Saved(NamedTuple):
    """What a checkpoint gives back."""

    step: int
    state: TrainState
    host: dict[str, Any]


class Checkpoints:
    """Checkpoints of one run, by environment steps.

    Saving is atomic (orbax writes beside and renames) and synchronous: the next chunk is given these very buffers to
    overwrite.
    """

    def __init__(self, directory: Path):
        options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, enable_async_checkpointing=False)
        for name in ("absl", "orbax"):
            logging.getLogger(name).setLevel(logging.ERROR)
        self._manager = ocp.CheckpointManager(directory.absolute(), options=options)

    def steps(self) -> list[int]:
        """Steps at which there is a checkpoint, oldest first."""
        return sorted(self._manager.all_steps())

    def save(self, step: int, state: TrainState, host: dict[str, Any], layout: Layout) -> None:
        """Saves the train state, and what the host knows beside it in JSON's types."""
        plain = jax.tree.map(_storable, layout.unpad(state))
        items = ocp.args.Composite(state=ocp.args.StandardSave(plain), host=ocp.args.JsonSave(host))
        self._manager.save(step, args=items, force=True)
        self._manager.wait_until_finished()

    def restore(self, shapes: TrainState, layout: Layout, warn: Callable[[str], None]) -> Saved | None:
        """The newest checkpoint that can be read, laid out on the mesh; None where there is none.

        Damaged ones are warned of and removed.

        Args:
            shapes: of the train state, as `jax.eval_shape` of its initialisation gives them.
        """
        unpadded = jax.eval_shape(layout.unpad, shapes)
        host_memory = jax.sharding.SingleDeviceSharding(jax.local_devices(backend="cpu")[0])
        plain = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=host_memory),
            jax.eval_shape(lambda tree: jax.tree.map(_storable, tree), unpadded),
        )
        for step in reversed(self.steps()):
            try:
                items = self._manager.restore(
                    step,
                    args=ocp.args.Composite(state=ocp.args.StandardRestore(plain), host=ocp.args.JsonRestore()),
                )
            except Exception as error:  # whatever a damaged file makes orbax raise
                _log.debug("checkpoint %d", step, exc_info=error)
                warn(f"the checkpoint at step {step} is damaged; taking the one before it")
                self._manager.delete(step)
                continue
            state = jax.tree.map(_restored, items["state"], unpadded)
            return Saved(step, layout.place(state), items["host"])
        return None

    def close(self) -> None:
        self._manager.close()


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
