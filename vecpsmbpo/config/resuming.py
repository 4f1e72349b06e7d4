"""The settings of a run, new or gone on with."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vecpsmbpo import loggers
from vecpsmbpo.algorithms.catalogue import build
from vecpsmbpo.config.composing import compose, from_tree
from vecpsmbpo.config.overrides import check_algorithm, parse
from vecpsmbpo.config.spelling import DOTTED
from vecpsmbpo.config.stored import CONFIG_FILE, load
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import SettingError, Settings

if TYPE_CHECKING:
    from omegaconf import DictConfig


def resolve(overrides: Sequence[str], tree: "DictConfig | None" = None) -> Settings:
    """The settings of a run, new or resumed: a `run_dir` that holds one resumes with its own.

    Args:
        overrides: `name=value` each.
        tree: what Hydra composed of them, where it already has (a job of a multirun).

    Raises:
        SettingError: a mistake in `overrides`, one contradicts the stored run, or a logger or the task's suite is not
            installed.
    """
    settings = _resolved(overrides, tree)
    loggers.check(settings.loggers)
    registry.check_installed(settings.env)
    return settings


def _resolved(overrides: Sequence[str], tree: "DictConfig | None") -> Settings:
    given = parse(overrides, sweep=tree is not None)

    def new() -> Settings:
        return compose(overrides) if tree is None else from_tree(tree, overrides)

    run_dir = given.get("run_dir") or ""
    if not run_dir or "${" in run_dir:
        run_dir = new().run_dir
    try:
        if not (Path(run_dir) / CONFIG_FILE).exists():
            return new()
    except (OSError, ValueError) as error:  # a name too long, or with a null byte
        raise SettingError(f"run_dir={run_dir}: {getattr(error, 'strerror', None) or error}") from None
    stored = load(run_dir)
    check_algorithm(stored.algo, given)
    changed: dict[str, Any] = {}
    for name, value in given.items():
        if name == "experiment":  # a name for a grid; what it sets has been given beside it
            continue
        group, _, option = name.rpartition(".")
        had = dict(getattr(stored, DOTTED[group])).get(option) if group else getattr(stored, name)
        if name == "run_dir" or value == had or (name, value) == ("backend", "auto"):
            continue
        if not stored.may_change(name):
            raise SettingError(
                f"{name}={value}: contradicts the run in {run_dir}, which has {name}={had}; "
                "leave it out to resume, or give another run_dir"
            )
        changed[name] = value
    return build({**dataclasses.asdict(stored), **changed})
