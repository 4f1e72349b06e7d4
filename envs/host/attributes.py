"""Saving what a Python environment keeps on itself, beside its physics: every number and array."""

from typing import Any

import numpy as np


def save(holder: Any) -> dict[str, Any]:
    """Numbers, arrays, and lists and tuples of them that `holder` has as attributes, in JSON's types.

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
    if isinstance(value, list | tuple):
        return type(value) in (list, tuple) and all(_is_data(item) for item in value)
    return value is None or isinstance(value, bool | int | float | np.generic)


def _encoded(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):  # with its type: float32 and float64 do not round alike
        return {"dtype": str(value.dtype), "values": value.tolist()}
    if isinstance(value, tuple):
        return {"tuple": [_encoded(item) for item in value]}
    return [_encoded(item) for item in value] if isinstance(value, list) else value


def _decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [_decoded(item) for item in value]
    if isinstance(value, dict) and "tuple" in value:
        return tuple(_decoded(item) for item in value["tuple"])
    if isinstance(value, dict):
        return np.array(value["values"], value["dtype"])[()]  # [()]: a scalar of numpy's stays one
    return value
