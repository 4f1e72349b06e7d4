"""Checks what the signatures of the numerical core say of shapes, wherever they are called or traced.

Only here: a run does not check. (jaxtyping's import hook would also check the fields of dataclasses, which hold shapes
and partition specs in the place of arrays where programs are laid out.)
"""

import importlib
import inspect
from typing import Any

from beartype import beartype
from jaxtyping import jaxtyped

CORE = ("sac", "networks", "dynamics", "replay", "posterior", "mixing", "imagination")
ALGORITHMS = ("pets.planning", "slbo.trpo", "slbo.multistep", "slbo.networks")


def check_core() -> None:
    """Its public functions and methods, before anything imports one of them by name."""
    for name in (*CORE, *(f"algorithms.{name}" for name in ALGORITHMS)):
        module = importlib.import_module(f"vecpsmbpo.{name}")
        _check_functions(module, module.__name__)
        for cls in [value for value in vars(module).values() if inspect.isclass(value)]:
            if cls.__module__ == module.__name__:
                _check_functions(cls, module.__name__)
        for table in [value for value in vars(module).values() if isinstance(value, dict)]:
            table.update({key: getattr(module, getattr(f, "__name__", ""), f) for key, f in table.items()})


def _check_functions(owner: Any, module: str) -> None:
    for name, value in list(vars(owner).items()):
        function = value.__func__ if isinstance(value, classmethod) else value
        own = inspect.isfunction(function) and function.__module__ == module
        if own and (not name.startswith("_") or name == "__call__"):
            checked = jaxtyped(typechecker=beartype)(function)
            setattr(owner, name, classmethod(checked) if isinstance(value, classmethod) else checked)
