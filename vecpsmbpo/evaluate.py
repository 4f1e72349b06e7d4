"""`vecpsmbpo eval`: whole episodes of a trained run's policies."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.table import Table

from vecpsmbpo import checkpoint, config, runtime
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import SettingError, check
from vecpsmbpo.train import evaluation_keys, initial_inputs, make_driver

_SETTINGS = {"episodes": "eval_episodes", "backend": "backend", "policy": "eval_policy", "devices": "devices"}


def evaluate(overrides: list[str]) -> int:
    """Prints the returns of `episodes` episodes per seed from the newest checkpoint.

    Args:
        overrides: `run_dir=`, and of `episodes=`, `backend=`, `policy=`, `devices=` as many as wanted.

    Raises:
        SettingError: a mistake in them, or no checkpoint.
    """
    given: dict[str, Any] = {}
    for text in overrides:
        name, equals, value = text.partition("=")
        if not equals or name not in ("run_dir", *_SETTINGS):
            raise SettingError(f"{text}: eval takes run_dir=…, {'=…, '.join(_SETTINGS)}=…")
        given[name] = value
    if "run_dir" not in given:
        raise SettingError("run_dir: eval needs run_dir=…, a directory that train has written")
    stored = config.load(given.pop("run_dir"))
    changes = {_SETTINGS[name]: check(_SETTINGS[name], value) for name, value in given.items()}
    changes["backend"] = registry.resolve_backend(stored.env, changes.get("backend", stored.backend))
    settings = dataclasses.replace(stored, **changes)

    runtime.configure(settings)
    trained = make_driver(stored)
    shapes = jax.eval_shape(trained.init, *initial_inputs(stored))
    checkpoints = checkpoint.Checkpoints(Path(stored.run_dir) / "checkpoints")
    saved = checkpoints.restore(shapes, trained.layout, warn=lambda text: Console(stderr=True).print(text))
    checkpoints.close()
    if saved is None:
        raise SettingError(f"run_dir={stored.run_dir}: holds no checkpoint yet")

    driver = trained if settings == stored else make_driver(settings)
    returns = driver.evaluate(saved.state, evaluation_keys(settings, saved.step), settings.eval_episodes)
    table = Table(title=f"{settings.env} ({settings.backend}) at step {saved.step}, policy: {settings.eval_policy}")
    for column in ("seed", "episodes", "return", "± s.d.", "lowest", "highest", "length"):
        table.add_column(column, justify="right")
    for index in range(settings.num_seeds):
        values, lengths = returns.episode_return[index], returns.length[index]
        row = (values.mean(), values.std(), values.min(), values.max(), lengths.mean())
        table.add_row(str(settings.seed + index), str(values.size), *(f"{value:.1f}" for value in row))
    Console(highlight=False).print(table)
    return 0
