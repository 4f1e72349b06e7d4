"""Settings from Python, as a command line would say them."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from vecpsmbpo.settings import SettingError

DOTTED = {"env": "env_options", "sweep": "sweep"}  # where the settings `env.*` and `sweep.*` are kept


def overrides_of(settings: Mapping[str, Any]) -> list[str]:
    """`name=value` as a command line would have it, of settings by name; `env_options` and `sweep` hold the settings
    `env.*` and `sweep.*`.

    Raises:
        SettingError: a value is of a type that no setting has.
    """
    dots = {kept: f"{group}." for group, kept in DOTTED.items()}
    found = []
    for name, value in settings.items():
        if name not in dots:
            found.append(as_override(name, value))
        elif not isinstance(value, Mapping):
            raise SettingError(f"{name}={value}: must be a dictionary")
        else:
            found += [f"{dots[name]}{inner}={_written(inner, item)}" for inner, item in value.items()]
    return found


def as_override(name: str, value: Any) -> str:
    """`name=value` as Hydra reads it back."""
    return f"{name}={_written(name, value)}"


def _written(name: str, value: Any) -> str:
    """A value as Hydra reads it back."""
    if hasattr(value, "tolist"):  # of NumPy or JAX
        value = value.tolist()
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ",".join(_written(name, item) for item in value) + "]"
    if not isinstance(value, str | Path):
        raise SettingError(f"{name}={value!r}: must be a number, a string, or a list of them")
    text = str(value)
    if re.fullmatch(r"[A-Za-z_./][\w./+-]*", text) and yaml.safe_load(text) == text:
        return text
    quoted = re.sub(r"(\\*)'", r"\1\1\\'", text)  # backslashes count before a quote, and at the end
    return "'" + re.sub(r"(\\+)$", r"\1\1", quoted) + "'"
