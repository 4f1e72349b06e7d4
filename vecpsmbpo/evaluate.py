"""Whole episodes of a trained run's policies: what `vecpsmbpo eval` shows and `Run.evaluate` returns."""

import contextlib
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from vecpsmbpo import checkpoint, crash, resources, runtime, words
from vecpsmbpo.drivers import Driver, Returns
from vecpsmbpo.programs import evaluation_keys, initial_inputs, make_driver
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.types import TrainState


def evaluate(stored: Settings, settings: Settings) -> tuple[int, Returns]:
    """Episodes of the newest checkpoint, and the environment steps after which it was written.

    Args:
        stored: of the run.
        settings: the same, with the backend and the policy to evaluate (`config.for_evaluation`).

    Raises:
        SettingError: the run holds no checkpoint.
    """
    stored = replace(stored, devices=settings.devices)
    trained, saved = restore(stored)
    driver = trained if settings == stored else make_driver(settings)
    crash.doing("evaluating")
    keys = evaluation_keys(settings, saved.step)
    return saved.step, driver.evaluate(saved.state, keys, settings.eval_episodes)


def show(stored: Settings, settings: Settings) -> int:
    """Prints what `evaluate` finds; the exit status."""
    step, returns = evaluate(stored, settings)
    title = f"{settings.task} ({settings.backend}) at step {step}"
    for name in ("eval_policy", "eval_actions"):  # not every algorithm has them
        if chosen := getattr(settings, name, ""):
            title += f", {name.removeprefix('eval_')}: {chosen}"
    print_returns(title, zip(settings.lanes, returns.episode_return, returns.length, strict=True))
    if returns.broken_off.any():
        count, of_all = returns.broken_off.sum(), returns.broken_off.size
        words.warn(f"the simulator diverged in {count} of {of_all} episodes; each ended there, with its return so far")
    return 0


def print_returns(title: str, rows: Iterable[tuple[dict[str, Any], np.ndarray, np.ndarray]]) -> None:
    """A table: of every row what names it, and returns and lengths of its episodes, [E] each."""
    table, rows = Table(title=escape(title)), list(rows)
    for column in (*rows[0][0], "episodes", "return", "± s.d.", "lowest", "highest", "length"):
        table.add_column(column, justify="right")
    for names, values, lengths in rows:
        row = (values.mean(), values.std(), values.min(), values.max(), lengths.mean())
        table.add_row(*map(str, names.values()), str(values.size), *(f"{value:.1f}" for value in row))
    Console(highlight=False).print(table)


def restore(stored: Settings) -> tuple[Driver, checkpoint.Saved]:
    """The driver of a run and its newest checkpoint.

    Raises:
        SettingError: the run holds no checkpoint, or none of these settings, or there is not enough memory for it.
    """
    with _opened(stored) as (driver, shapes, checkpoints):
        saved = checkpoints.restore(shapes, driver.layout, warn=words.warn)
    if saved is None:
        raise SettingError(f"run_dir={stored.run_dir}: holds no checkpoint yet")
    return driver, saved


def restore_each(stored: Settings, steps: Collection[int] = ()) -> Iterator[tuple[Driver, checkpoint.Saved]]:
    """As `restore`, of every checkpoint that is kept and can be read, or of those at `steps`; oldest first and one at a
    time.

    Raises:
        SettingError: there is not enough memory, or there are checkpoints and none of them can be read.
    """
    read, errors = False, []
    with _opened(stored) as (driver, shapes, checkpoints):
        for step in checkpoints.steps():
            if steps and step not in steps:
                continue
            try:
                saved = checkpoints.restore(shapes, driver.layout, warn=lambda text: None, at=step)
            except SettingError as error:
                errors.append(error)
            else:
                assert saved is not None
                read = True
                yield driver, saved
                del saved  # before the next is read: one state is all there may be room for
    if errors and not read:
        raise errors[-1]
    for passed_over in errors:
        words.warn(str(passed_over))


@contextlib.contextmanager
def _opened(stored: Settings) -> Iterator[tuple[Driver, TrainState, checkpoint.Checkpoints]]:
    """A run's driver, the shapes of its state, and its checkpoints to be read."""
    runtime.configure(stored)
    driver = make_driver(stored)
    shapes = driver.shapes(*initial_inputs(stored))
    resources.check_memory(driver.algorithm, shapes)
    checkpoints = checkpoint.Checkpoints(Path(stored.run_dir) / checkpoint.FOLDER, stored, read_only=True)
    try:
        yield driver, shapes, checkpoints
    finally:
        checkpoints.close()
