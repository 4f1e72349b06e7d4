"""What there is to choose from: the groups of `configs/` with their names, and what holds where nothing is chosen."""

import difflib
from collections.abc import Iterable
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

GROUPS = ("env", "algo", "size", "recipe")


def options(group: str) -> list[str]:
    """The names that `group=` may take."""
    folder = resources.files("vecpsmbpo.configs") / group
    return sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".yaml"))


def env_options(env: str) -> dict[str, Any]:
    """The options `env.*` of a task and their defaults; `???` where one must be given."""
    text = (resources.files("vecpsmbpo.configs") / "env" / f"{env}.yaml").read_text()
    return {name: value for name, value in yaml.safe_load(text)["env"].items() if name != "name"}


def closest(name: str, known: Iterable[str]) -> str:
    """What may have been meant by `name`, for the end of an error line."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.4)
    return f"did you mean {' or '.join(near)}?" if near else f"one of {', '.join(known)}"


def defaults(algo: str = "") -> dict[str, Any]:
    """What `configs/config.yaml` says, and for the settings that only this algorithm has, `configs/algo/settings`."""
    folder = resources.files("vecpsmbpo.configs")
    found = yaml.safe_load((folder / "config.yaml").read_text())
    own = folder / "algo" / "settings" / f"{algo}.yaml"
    return {**found, **(yaml.safe_load(own.read_text()) if own.is_file() else {})}


def default(group: str) -> str:
    return next(entry[group] for entry in defaults()["defaults"] if group in entry)
