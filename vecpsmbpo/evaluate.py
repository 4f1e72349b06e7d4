"""`vecpsmbpo eval`: whole episodes of a trained run's policies."""

import contextlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from vecpsmbpo import checkpoint, config, crash, resources, runtime
from vecpsmbpo.drivers import Driver
from vecpsmbpo.drivers.common import evaluation_policies
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.train import evaluation_keys, initial_inputs, make_driver
from vecpsmbpo.types import TrainState


def evaluate(stored: Settings, settings: Settings) -> int:
    """Prints the returns of `settings.eval_episodes` episodes per seed from the newest checkpoint.

    Args:
        stored: of the run.
        settings: the same, with the backend and the policy to evaluate (`config.resolve_evaluation`).

    Raises:
        SettingError: the run holds no checkpoint.
    """
    runtime.configure(settings)
    stored = replace(stored, devices=settings.devices)
    trained, saved = restore(stored)
    driver = trained if settings == stored else make_driver(settings)
    crash.doing("evaluating")
    returns = driver.evaluate(saved.state, evaluation_keys(settings, saved.step), settings.eval_episodes)
    who = f"policy: {settings.eval_policy}, {settings.eval_actions} actions"
    table = Table(title=f"{settings.task} ({settings.backend}) at step {saved.step}, {who}")
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
    with _opened(stored) as (driver, shapes, checkpoints):
        saved = checkpoints.restore(shapes, driver.layout, warn=_warn)
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
        _warn(str(passed_over))


@contextlib.contextmanager
def _opened(stored: Settings) -> Iterator[tuple[Driver, TrainState, checkpoint.Checkpoints]]:
    """A run's driver, the shapes of its state, and its checkpoints to be read."""
    driver = make_driver(stored)
    shapes = driver.shapes(*initial_inputs(stored))
    resources.check_memory(stored, driver.algorithm.spec, driver.layout, shapes)
    checkpoints = checkpoint.Checkpoints(Path(stored.run_dir) / "checkpoints", read_only=True)
    try:
        yield driver, shapes, checkpoints
    finally:
        checkpoints.close()


def _warn(text: str) -> None:
    Console(stderr=True).print(text)


def load_policy(run_dir: str | Path) -> tuple[Settings, Callable[[jax.Array], jax.Array]]:
    """A trained policy of the first seed, to be used outside of this program: of the best member (`posterior.best`);
    with `posterior=average`, where nobody earns anything, the mean of all members' actions.

    Returns:
        The run's settings, and its mean action as a jitted function: obs [..., O] -> action [..., A] in [-1, 1].

    Raises:
        SettingError: there is no run in `run_dir`, it holds no checkpoint, or its algorithm has no policy (PETS).
    """
    settings = config.load(run_dir)
    if settings.plans:
        raise SettingError(f"run_dir={run_dir}: algo={settings.algo} plans its actions; there is no policy to load")
    one = replace(settings, posterior="sample", eval_policy="best", eval_actions="mean")
    driver, saved = restore(one)
    algorithm, seeds = driver.algorithm, saved.state.seeds
    step, key = jnp.int32(0), jax.random.key(0)  # a policy, unlike a plan, needs neither

    def action(policy: Any, obs: jax.Array) -> jax.Array:
        return algorithm.evaluation_action(policy, step, algorithm.memory(), obs, key)[0]

    if settings.posterior == "average":
        members = jax.tree.map(lambda x: x[0], driver.layout.unpad(saved.state).seeds.agents.actor)
        return settings, jax.jit(lambda obs: jax.vmap(action, (0, None))(members, obs).mean(axis=0))
    policy = jax.tree.map(lambda x: x[0], evaluation_policies(algorithm)(seeds, seeds.key))
    return settings, jax.jit(partial(action, policy))
