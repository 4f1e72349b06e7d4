"""Every setting that some algorithm has, by name, and settings made of plain values."""

import dataclasses
import struct
from collections.abc import Mapping
from typing import Any

from vecpsmbpo.algorithms import TABLE
from vecpsmbpo.settings import SettingError, Settings, fields


def of_algorithm(algo: str) -> dict[str, Any]:
    """The fields of an algorithm's settings that a command line names; the options of a task are `env.*` there, and
    what is swept is `sweep.*`."""
    found = dataclasses.fields(TABLE[algo].settings)
    return {field.name: field for field in found if field.name not in ("env_options", "sweep")}


# Algorithms that have a setting of the same name mean the same by it.
FIELDS = {name: field for algo in TABLE for name, field in of_algorithm(algo).items()}
# Numbers inside the compiled program (`types.Hyper`), each once.
TRACED = tuple(dict.fromkeys(name for entry in TABLE.values() for name in fields.traced(entry.settings)))


def having(name: str) -> list[str]:
    """The algorithms that have the setting `name`."""
    return [algo for algo in TABLE if name in of_algorithm(algo)]


def require(algo: str, name: str) -> None:
    """Raises:
    SettingError: there is a setting `name`, or `sweep.<name>`, but not with this algorithm.
    """
    if (owners := having(name.removeprefix("sweep."))) and algo not in owners:
        raise SettingError(f"{name}: algo={algo} has no such setting; algo={' or '.join(owners)} has")


def allowed(name: str) -> str:
    """What the setting `name` may be, in words."""
    return fields.allowed(FIELDS[name])


def check(name: str, value: Any) -> Any:
    """`value` as the type of the setting `name`.

    Raises:
        SettingError: the value has the wrong type or lies out of range.
    """
    return fields.check(FIELDS[name], value)


def check_sweep(name: str, values: Any) -> tuple[float, ...]:
    """The values of `sweep.<name>=[...]`.

    Raises:
        SettingError: the setting cannot be swept inside one program, or a value is wrong.
    """
    if name not in TRACED:
        raise SettingError(f"sweep.{name}: cannot be swept in one program (-m can); one of {', '.join(TRACED)}")
    if not isinstance(values, list | tuple) or not values:
        raise SettingError(f"sweep.{name}={values}: must be a list of values, each {allowed(name)}")
    checked = tuple(check(name, value) for value in values)
    if len({*map(told_apart, checked)}) < len(checked):
        raise SettingError(f"sweep.{name}={list(values)}: two of its values are the same in float32")
    return checked


def told_apart(value: Any) -> Any:
    """By what a checked value differs from others: a real number by its float32, in which there is one zero here."""
    if isinstance(value, tuple):
        return tuple(map(told_apart, value))
    return struct.pack("f", value + 0.0) if isinstance(value, float) and abs(value) <= fields.LARGEST else repr(value)


def build(values: Mapping[str, Any]) -> Settings:
    """Settings of the algorithm that `values` names, each checked, and checked against one another. Values that it has
    no use for are left out.

    Raises:
        SettingError: a value is wrong, or two contradict.
    """
    options = tuple(sorted(dict(values.get("env_options", ())).items()))
    sweep = tuple((name, check_sweep(name, swept)) for name, swept in sorted(dict(values.get("sweep", ())).items()))
    if (algo := values["algo"]) not in TABLE:
        raise SettingError(f"algo={algo}: must be one of {', '.join(TABLE)}")
    for name, _ in sweep:
        require(algo, f"sweep.{name}")
    checked = {name: check(name, values[name]) for name in of_algorithm(algo)}
    settings = TABLE[algo].settings(env_options=options, sweep=sweep, **checked)
    for wrong, complaint in settings.contradictions():
        if wrong:
            raise SettingError(complaint)
    return settings
