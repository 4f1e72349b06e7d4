"""What a command line says, word by word: each `name=value` checked by itself, before anything is composed."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import yaml

from vecpsmbpo.algorithms.catalogue import FIELDS, check, check_sweep, require, told_apart
from vecpsmbpo.config.choices import GROUPS, closest, default, env_options, options
from vecpsmbpo.settings import SettingError

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

MOST_VALUES = 10_000  # of one setting in a grid; a typing error may make it endless


def parse(overrides: Sequence[str], *, sweep: bool = False) -> dict[str, Any]:
    """Checks each override on its own: its name, and what its value may be.

    Args:
        overrides: `name=value` each.
        sweep: values may be several, as Hydra's multirun has them.

    Returns:
        Value by name.

    Raises:
        SettingError: what is wrong with the first wrong one.
    """
    found: dict[str, Any] = {}
    algorithms: list[str] = []
    for text in overrides:
        if "=" not in text:
            raise SettingError(f"{text}: must be name=value")
        override = _read(text)
        name = override.key_or_group
        if override.is_delete():
            raise SettingError(f"{text}: a setting cannot be taken away; give it another value")
        if sweep and name.startswith("hydra"):
            continue
        if override.is_sweep_override() and not sweep:
            raise SettingError(f"{text}: several values need -m")
        given = _sweep_values(override) if override.is_sweep_override() else [override.value()]
        values = [check_override(name, value) for value in given]
        if len(set(map(told_apart, values))) < len(values):
            raise SettingError(f"{text}: the same value twice")
        found[name] = values[-1]
        algorithms += values if name == "algo" else []
    if "experiment" in found and not sweep:
        raise SettingError(f"experiment={found['experiment']}: is a grid of runs and needs -m")
    _check_env_options(found)
    if sweep and "experiment" not in found:
        for algo in algorithms or [default("algo")]:
            check_algorithm(algo, found)
    return found


def _read(text: str) -> "Override":
    """As Hydra reads it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    try:
        return OverridesParser.create().parse_override(text)
    except HydraException as error:
        raise SettingError(f"{text}: is not a value that can be read ({first_line(error)})") from None


def name_of(text: str) -> str:
    """What an override names, `sweep.*` with Hydra's plus signs or without."""
    return text.partition("=")[0].lstrip("+")


def chosen(group: str, text: str) -> list[str]:
    """The names that an override chooses of a group of Hydra's, quoted or not; none where it is of something else."""
    override = _read(text)
    value = override.value() if override.key_or_group == group else []
    return [str(name) for name in (value if isinstance(value, list) else [value])]


def _check_env_options(found: dict[str, Any]) -> None:
    """That the task has the options given; a run that is resumed knows its task by itself."""
    given = [name for name in found if name.startswith("env.")]
    if "env" not in found and "run_dir" in found:
        return
    for name in given:
        env = found.get("env", default("env"))
        if name.removeprefix("env.") not in env_options(env):
            has = ", ".join(f"env.{option}" for option in env_options(env)) or "none"
            raise SettingError(f"{name}: no such option of env={env}; it has {has}")


def check_env_values(env: str, given: Mapping[str, Any]) -> None:
    """That the options of a task have the types of their defaults; one that must be given is a name.

    Raises:
        SettingError: one has another.
    """
    for name, usual in env_options(env).items():
        value = given.get(name, usual)
        if isinstance(usual, str):
            wrong, what = not isinstance(value, str) or not value, "a name"
        else:
            wrong, what = isinstance(value, bool) or not isinstance(value, int | float), "a number"
        if wrong:
            raise SettingError(f"env.{name}={value}: must be {what}")


def check_algorithm(algo: str, names: Iterable[str]) -> None:
    """That the algorithm has the settings given."""
    for name in names:
        require(algo, name)


def _sweep_values(override: "Override") -> list[Any]:
    from hydra.errors import HydraException

    try:
        values = list(islice(override.sweep_iterator(), MOST_VALUES + 1))
    except HydraException:
        raise SettingError(f"{override.input_line}: only a,b,… or choice() and range() can be swept") from None
    except ValueError as error:
        raise SettingError(f"{override.input_line}: {first_line(error)}") from None
    if not 0 < len(values) <= MOST_VALUES:
        count = "no value" if not values else f"more than {MOST_VALUES} values"
        raise SettingError(f"{override.input_line}: is a range of {count}")
    return [yaml.safe_load(value) if isinstance(value, str) else value for value in values]


def check_override(name: str, value: Any) -> Any:
    """`value` as the type of what `name` says, a setting or a group.

    Raises:
        SettingError: there is no such setting, group or choice of it, or the value is of another type.
    """
    if name in (*GROUPS, "experiment"):
        if value not in options(name):
            raise SettingError(f"{name}={value}: {closest(str(value), options(name))}")
        return value
    if name.startswith("env."):
        return value
    if name.startswith("sweep."):
        return check_sweep(name.removeprefix("sweep."), value)
    if name not in FIELDS:
        raise SettingError(f"{name}: no such setting; {closest(name, FIELDS)}")
    return check(name, "" if value is None and FIELDS[name].type is str else value)


def first_line(error: Exception) -> str:
    """Of what an error says."""
    return (str(error).strip() or repr(error)).splitlines()[0]
