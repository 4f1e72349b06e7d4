"""Saving what a Python environment keeps on itself, beside its physics: every number and array."""

from collections import deque
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def save(holder: Any) -> dict[str, Any]:
    """Numbers, texts, NumPy and JAX arrays, and lists, tuples, dictionaries and deques of them that `holder` has as
    attributes, in JSON's types. Anything else (an object of the environment's own, say) is not saved.

    Not only the few that every task needs (former frame, path length): rewards keep what they like on the environment.
    """
    return {name: _encoded(value) for name, value in vars(holder).items() if _is_data(value)}


def load(holder: Any, saved: dict[str, Any]) -> None:
    """The inverse of `save`."""
    for name, value in saved.items():
        setattr(holder, name, _decoded(value))


def _is_data(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            return False
        # Some tasks keep a window into MuJoCo's memory instead of a copy. It moves with the simulation, and must.
        while isinstance(value, np.ndarray):
            value = value.base
        return value is None
    if isinstance(value, jax.Array):
        return not jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key)
    if type(value) in (list, tuple, deque):
        return all(_is_data(item) for item in value)
    if type(value) is dict:
        return all(isinstance(name, str) and _is_data(item) for name, item in value.items())
    return value is None or isinstance(value, bool | int | float | str | np.generic)


def _encoded(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):  # with its type: float32 and float64 do not round alike
        return {"dtype": str(value.dtype), "values": value.tolist()}
    if isinstance(value, jax.Array):
        return {"jax": _encoded(np.asarray(value))}
    if isinstance(value, list):
        return [_encoded(item) for item in value]
    if isinstance(value, tuple):
        return {"tuple": [_encoded(item) for item in value]}
    if isinstance(value, deque):
        return {"deque": [_encoded(item) for item in value], "maxlen": value.maxlen}
    if isinstance(value, dict):
        return {"dict": {name: _encoded(item) for name, item in value.items()}}
    return value


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "jax" in value:
        return jnp.asarray(_decoded(value["jax"]))
    if "tuple" in value:
        return tuple(_decoded(item) for item in value["tuple"])
    if "deque" in value:
        return deque((_decoded(item) for item in value["deque"]), value["maxlen"])
    if "dict" in value:
        return {name: _decoded(item) for name, item in value["dict"].items()}
    return np.array(value["values"], value["dtype"])[()]  # [()]: a scalar of numpy's stays one
