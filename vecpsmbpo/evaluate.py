"""Whole episodes of a trained run's policies: what `vecpsmbpo eval` shows and `Run.evaluate` returns."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from vecpsmbpo import checkpoint, crash, resources, runtime
from vecpsmbpo.drivers import Driver, Returns
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.training.programs import evaluation_keys, initial_inputs, make_driver


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
    who = f"policy: {settings.eval_policy}, {settings.eval_actions} actions"
    table = Table(title=f"{settings.task} ({settings.backend}) at step {step}, {who}")
    for column in (*settings.lanes[0], "episodes", "return", "± s.d.", "lowest", "highest", "length"):
        table.add_column(column, justify="right")
    for index, lane in enumerate(settings.lanes):
        values, lengths = returns.episode_return[index], returns.length[index]
        row = (values.mean(), values.std(), values.min(), values.max(), lengths.mean())
        table.add_row(*map(str, lane.values()), str(values.size), *(f"{value:.1f}" for value in row))
    Console(highlight=False).print(table)
    return 0


def restore(stored: Settings) -> tuple[Driver, checkpoint.Saved]:
    """The driver of a run and its newest checkpoint.

    Raises:
        SettingError: the run holds no checkpoint, or there is not enough memory for it.
    """
    runtime.configure(stored)
    driver = make_driver(stored)
    shapes = driver.shapes(*initial_inputs(stored))
    resources.check_memory(stored, driver.algorithm.spec, driver.layout, shapes)
    checkpoints = checkpoint.Checkpoints(Path(stored.run_dir) / "checkpoints", read_only=True)
    saved = checkpoints.restore(shapes, driver.layout, warn=lambda text: Console(stderr=True).print(text))
    checkpoints.close()
    if saved is None:
        raise SettingError(f"run_dir={stored.run_dir}: holds no checkpoint yet")
    return driver, saved
