"""Checks what the signatures of the numerical core say of shapes, wherever they are called or traced.

Only here: a run does not check. (jaxtyping's import hook would also check the fields of dataclasses, which hold shapes
and partition specs in the place of arrays where programs are laid out.)
"""

import importlib
import inspect
from pathlib import Path
from typing import Any

from beartype import beartype
from jaxtyping import jaxtyped

PACKAGE = Path(__file__).parents[1] / "vecpsmbpo"
NAMES = "types"  # of kinds of arrays; it has no functions over them


def core() -> list[str]:
    """The modules whose signatures say shapes, those that others import first."""
    said = [path for path in PACKAGE.rglob("*.py") if "\nfrom jaxtyping import" in path.read_text()]
    names = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in said if path.stem != NAMES]
    return sorted(names, key=lambda name: (name.count("algorithm"), name))


def check_core() -> None:
    """Their public functions and methods, before anything imports one of them by name."""
    for name in core():
        module = importlib.import_module(name)
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
