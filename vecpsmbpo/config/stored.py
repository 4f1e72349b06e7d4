"""A run's settings on disk: `config.yaml`, and the same record in an exported policy."""

import dataclasses
from pathlib import Path
from typing import Any

import yaml

from vecpsmbpo import atomic, recorded
from vecpsmbpo.algorithms.catalogue import build
from vecpsmbpo.config.choices import defaults
from vecpsmbpo.config.overrides import check_env_values, check_override, first_line
from vecpsmbpo.settings import SettingError, Settings

CONFIG_FILE = "config.yaml"


def save(settings: Settings, run_dir: Path) -> None:
    """Writes `config.yaml`: not with whom it was run, which is over when it ends."""
    plain = recorded.plain(dataclasses.replace(settings, distributed=""))
    # At once: a run whose config is cut short could not be resumed.
    atomic.write_text(run_dir / CONFIG_FILE, yaml.safe_dump(plain, sort_keys=False))


def load(run_dir: str | Path) -> Settings:
    """The settings that a run directory was started with.

    Raises:
        SettingError: there are none, or they cannot be read.
    """
    where = f"run_dir={run_dir}: its {CONFIG_FILE}"
    try:
        record = yaml.safe_load((Path(run_dir) / CONFIG_FILE).read_text())
    except OSError:
        raise SettingError(f"run_dir={run_dir}: holds no {CONFIG_FILE}, so no run") from None
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise SettingError(f"{where} cannot be read ({first_line(error)})") from None
    return dataclasses.replace(from_record(record, where), run_dir=str(run_dir))


def from_record(record: Any, where: str) -> Settings:
    """The settings that `recorded.plain` wrote down.

    Args:
        record: what is found there, which may be anything.
        where: for the error.

    Raises:
        SettingError: it is none.
    """
    try:
        # What the run does not know came to this program after it, and is off by default.
        values = {**defaults(record["algo"]), "recipe": "paper", **record}
        for group in ("env", "algo"):
            check_override(group, values[group])
        check_env_values(values["env"], dict(values.get("env_options", ())))
        return build(values)
    except SettingError as error:
        raise SettingError(f"{where} has {error}") from None
    except (LookupError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
        raise SettingError(f"{where} cannot be read ({first_line(error)})") from None
