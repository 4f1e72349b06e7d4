"""A new run's settings: what Hydra composes of `configs/` and a command line.

Hydra is imported by whoever composes: `--help`, and commands that only read runs, answer sooner without it.
"""

import contextlib
import dataclasses
import hashlib
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vecpsmbpo.algorithms.catalogue import build, check
from vecpsmbpo.config.choices import GROUPS, default
from vecpsmbpo.config.overrides import check_algorithm, check_env_values, first_line, name_of, parse
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import CHANGEABLE, SettingError, Settings

if TYPE_CHECKING:
    from omegaconf import DictConfig

LONGEST_NAME = 200  # of a default run directory, in bytes; file systems take 255
# What the name of a default run directory already says, or need not say.
_UNNAMED = frozenset({*GROUPS, "seed", "run_dir", *CHANGEABLE})


def compose(overrides: Sequence[str]) -> Settings:
    """The settings of a new run.

    Raises:
        SettingError: a mistake in `overrides`.
    """
    given = parse(overrides)
    check_algorithm(given.get("algo", default("algo")), given)
    return _compose(overrides)


def compose_point(experiment: str, overrides: Sequence[str]) -> Settings:
    """The settings of one run of an experiment, which is a grid of them; `overrides` say which."""
    return _compose([f"experiment={experiment}", *overrides])


def _compose(overrides: Sequence[str]) -> Settings:
    import hydra

    with hydra_errors(), hydra.initialize_config_module("vecpsmbpo.configs", version_base="1.3"):
        tree = hydra.compose("config", for_hydra(overrides))
    return from_tree(tree, overrides)


@contextlib.contextmanager
def hydra_errors() -> Iterator[None]:
    """Turns what Hydra complains of into one line."""
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise SettingError(first_line(error)) from None


def for_hydra(overrides: Iterable[str]) -> list[str]:
    """The same for Hydra, which adds a name to a group, as `sweep.*` needs, only where it is told to."""
    return [f"++{text}" if text.startswith("sweep.") else text for text in overrides]


def from_tree(tree: "DictConfig", overrides: Sequence[str]) -> Settings:
    """Settings from what Hydra composed, with the backend and the run directory resolved.

    Args:
        overrides: `name=value`, as given, for what is said of a mistake.

    Raises:
        SettingError: a value that is missing, of another type or out of range, or settings that contradict one another.
    """
    from omegaconf import OmegaConf

    with hydra_errors():
        values: Any = OmegaConf.to_container(tree, resolve=True)
    values["sweep"] = values["sweep"] or {}
    values["env_options"] = {name: value for name, value in values["env"].items() if name != "name"}
    for group in GROUPS:
        values[group] = values[group]["name"]
    check_algorithm(values["algo"], map(name_of, overrides))
    for name, value in values["env_options"].items():
        if value == "???":
            raise SettingError(f"env.{name}: must be given with env={values['env']}")
    check_env_values(values["env"], values["env_options"])
    values["backend"] = registry.resolve_backend(values["env"], check("backend", values["backend"]))
    settings = build(values)
    if not settings.run_dir:
        settings = dataclasses.replace(settings, run_dir=_default_run_dir(settings, overrides))
    return settings


def _default_run_dir(settings: Settings, overrides: Sequence[str]) -> str:
    """The same command gives the same directory, so that running it again goes on with the run."""
    extra = sorted(text for text in overrides if name_of(text) not in _UNNAMED)
    task = [str(value) for _, value in settings.env_options if any(text.startswith("env.") for text in extra)]
    others = [text for text in extra if not text.startswith(("hydra", "env.", "experiment="))]
    experiment = [text.removeprefix("experiment=") for text in extra if text.startswith("experiment=")]
    parts = [settings.env, *task, settings.algo, settings.size, f"seed{settings.seed}", *others]
    # Only what the command line reads back without quotes.
    name = "-".join(re.sub(r"[^\w.+-]", "_", part.replace("=", "")) for part in parts)
    if len(name.encode()) > LONGEST_NAME:
        name = f"{name[: LONGEST_NAME // 4]}-{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return str(Path("runs", *experiment) / name)
