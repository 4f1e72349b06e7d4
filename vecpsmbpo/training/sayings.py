"""What a run says of itself while it trains, in lines."""

import shlex
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax

from vecpsmbpo import config, versions
from vecpsmbpo.envs import speeds
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import LARGEST_NUMBER


def introduction(settings: Settings, devices: list[str], memory: str, env_steps: int) -> Iterator[str]:
    """What runs, on what, and where.

    Args:
        devices: the kind of each that the run uses.
        memory: what it needs and has, in words.
        env_steps: that it goes on from.
    """
    kinds = ", ".join(f"{count} × {kind}" for kind, count in Counter(devices).items())
    yield f"{versions.line()}; devices: {kinds}"
    swept = "".join(f"{len(values)} values of {name} × " for name, values in settings.sweep)
    yield (
        f"{settings.task} ({settings.backend}), {settings.algo}: {settings.num_seeds} seed(s) × {swept}"
        f"{settings.summary}, on {len(devices)} {jax.default_backend()} device(s)"
    )
    if hint := speeds.hint(settings.env, settings.backend, jax.default_backend(), len(settings.lanes)):
        yield hint
    yield f"memory: {memory}"
    where = f"resuming at step {env_steps}" if env_steps else "starting"
    yield f"run directory: {Path(settings.run_dir)} ({where})"


def compiling(settings: Settings) -> str:
    cached = "; the compilation cache makes this short next time" if settings.compile_cache else ""
    return f"compiling the training program{cached} …"


def complete(env_steps: int) -> str:
    return f"already complete at {env_steps} steps; raise total_steps to go on"


def frozen(settings: Settings, lane: int, step: int, what: str) -> str:
    """Of a lane in which `what` stopped being finite in the stride that ended at `step`."""
    name = ", ".join(f"{name} {value:g}" for name, value in settings.lanes[lane].items())
    return f"{name} is frozen as it was at step {step - settings.stride}: {what} stopped being finite by step {step}"


def unsound(settings: Settings, steps: int, of_steps: int) -> str:
    """Of a task whose simulator diverged at some steps of an epoch: also where it was once, since that is a fault, and
    not so often as to hide anything else."""
    return (
        f"the simulator of {settings.task} diverged (NaN, infinity, or numbers beyond {LARGEST_NUMBER:g}) at {steps} "
        f"of {of_steps} steps of this epoch; each of them ended its episode, and none is stored"
    )


def broken_off(settings: Settings, episodes: int, of_episodes: int) -> str:
    """Of a task whose simulator diverged in an evaluation."""
    return (
        f"the simulator of {settings.task} diverged in {episodes} of {of_episodes} episodes of this evaluation; each "
        "ended there, with its return so far"
    )


def farewell(settings: Settings, env_steps: int, *, all_frozen: bool, complete: bool) -> Iterator[str]:
    """Where it is saved, and what may be done with that."""
    run_dir = Path(settings.run_dir)
    yield f"saved at step {env_steps} of {settings.total_steps}: {run_dir}"
    if all_frozen:
        yield "stopped: every lane is frozen; what is saved is the last good state of each"
    elif not complete:
        yield f"to continue: {to_continue(settings)}"
    else:
        yield f"to evaluate: vecpsmbpo eval {shlex.quote(f'run_dir={run_dir}')} episodes=10"


def failed(settings: Settings, where: str, error: Exception, saved_step: int | None) -> str:
    """Of a task whose own code raised `error`."""
    return f"{settings.task} failed {where}: {error}; saved at step {saved_step}; to continue: {to_continue(settings)}"


def to_continue(settings: Settings) -> str:
    """The command, as a shell and Hydra read it."""
    if settings.distributed:
        return "the same command again, in every process"
    return f"vecpsmbpo train {shlex.quote(config.as_override('run_dir', Path(settings.run_dir)))}"
