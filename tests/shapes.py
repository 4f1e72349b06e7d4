"""Checks what the signatures of the numerical core say of shapes, wherever they are called or traced.

Only here: a run does not check. (jaxtyping's import hook would also check the fields of dataclasses, which hold shapes
and partition specs in the place of arrays where programs are laid out.)
"""

import importlib
import inspect
from typing import Any

from beartype import beartype
from jaxtyping import jaxtyped

CORE = ("sac", "networks", "dynamics", "replay", "posterior", "mixture", "imagination")
ALGORITHMS = ("pets.planning", "slbo.trpo", "slbo.multistep", "slbo.networks")


def check_core() -> None:
    """Before anything imports a single function of it."""
    for name in (*CORE, *(f"algorithms.{name}" for name in ALGORITHMS)):
        module = importlib.import_module(f"vecpsmbpo.{name}")
        _check_functions(module, module.__name__)
        for cls in [value for value in vars(module).values() if inspect.isclass(value)]:
            if cls.__module__ == module.__name__:
                _check_functions(cls, module.__name__)


def _check_functions(owner: Any, module: str) -> None:
    for name, value in list(vars(owner).items()):
        own = inspect.isfunction(value) and value.__module__ == module
        if own and (not name.startswith("_") or name == "__call__"):
            setattr(owner, name, jaxtyped(typechecker=beartype)(value))
