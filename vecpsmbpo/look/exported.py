"""A policy that `vecpsmbpo export` has written, where a run would be: `vecpsmbpo.load`, `eval` and `render` take it."""

import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo import config, crash, feedforward, words
from vecpsmbpo.envs import registry
from vecpsmbpo.feedforward import RULES, Feedforward
from vecpsmbpo.settings import SettingError, Settings

Array = np.ndarray

WEIGHTS_FILE, ABOUT_FILE = "policy.npz", "policy.json"
ALONE = ("policy", "actions", "devices")  # what is told of a run's evaluation, and has no meaning for one policy
DAMAGE = (
    *(OSError, LookupError, TypeError, AttributeError, ValueError, RecursionError),
    *(EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error),
)


@dataclass(frozen=True)
class Exported:
    """One policy by itself.

    Attributes:
        path: the directory.
        settings: of the run that it comes from.
        about: what policy.json has beside them: task, run, seed, member, env_steps, ...
        network: obs [..., O] -> mean action [..., A] in [-1, 1].
    """

    path: Path
    settings: Settings
    about: Mapping[str, Any]
    network: Feedforward


def is_one(path: str | Path) -> bool:
    """Whether a directory holds an exported policy, and no run."""
    path = Path(path)
    try:
        return (path / ABOUT_FILE).is_file() and not (path / config.CONFIG_FILE).exists()
    except (OSError, ValueError):  # a name too long, or with a null byte: whoever takes it for a run says so
        return False


def load(path: str | Path) -> Exported:
    """The policy in a directory.

    Raises:
        SettingError: its files cannot be read, or were written by a version that did not keep the run's settings.
    """
    path = Path(path)
    try:
        about = json.loads((path / ABOUT_FILE).read_text())
        record = about.pop("settings")
        with np.load(path / WEIGHTS_FILE) as stored:
            layers = feedforward.layers_of({name: stored[name] for name in stored.files})
        network = Feedforward(layers, **about.pop("network", {}))  # which those written before 2026-11-29 lack
        settings = replace(config.from_record(record, f"{path}: its {ABOUT_FILE}"), run_dir="")
        _check(network, registry.TASKS[settings.env].sizes)
    except DAMAGE as error:
        raise SettingError(f"{path}: holds no policy that can be read ({words.of(error)})") from None
    return Exported(path, settings, about, network)


def _check(network: Feedforward, task: Sequence[int] | None) -> None:
    """That its layers fit together, and observations and actions as the task has them, where that is known.

    Raises:
        ValueError: they do not, or a rule between them is not known.
    """
    if not {network.hidden, network.end} <= RULES.keys():
        raise ValueError(f"{ABOUT_FILE} names a rule that is not one of {', '.join(RULES)}")
    layers = network.layers
    whole = all(kernel.ndim == 2 and kernel.shape[1:] == bias.shape for kernel, bias in layers)
    kinds = {array.dtype.kind for layer in layers for array in layer}
    if not layers or not whole or kinds != {"f"} or any(len(k) != len(b) for (_, b), (k, _) in pairwise(layers)):
        raise ValueError(f"{WEIGHTS_FILE} has not the layers of a policy")
    has = (network.obs_size, network.action_size)
    if task and has != tuple(task[:2]):
        raise ValueError(f"from {has[0]} observations to {has[1]} actions, where the task has {task[0]} and {task[1]}")


def for_evaluation(policy: Exported, given: Mapping[str, Any]) -> Settings:
    """Settings of its run, with `episodes` and `backend` as of `vecpsmbpo eval`.

    Raises:
        SettingError: a mistake in `given`.
    """
    for name in given:
        if name in ALONE:
            raise SettingError(f"{name}={given[name]}: {policy.path} is one policy and its mean actions, without a run")
    return config.for_evaluation(policy.settings, given)


def evaluate(policy: Exported, settings: Settings, seed: int = 0) -> tuple[Array, Array]:
    """Whole episodes of the task, side by side: their returns and lengths, [E] each.

    Args:
        settings: as `for_evaluation` gives them.
        seed: of the environments.

    Raises:
        SettingError: the task's suite is not installed.
    """
    import jax

    from vecpsmbpo import runtime
    from vecpsmbpo.look import fresh

    runtime.configure(settings)
    world = fresh.world(settings, settings.eval_episodes, settings.episode_length, seed)
    crash.doing("evaluating")
    certain = np.zeros(settings.eval_episodes)
    seen = fresh.collect(world, lambda t, obs, key: (policy.network(obs), certain), world.length, jax.random.key(seed))
    return seen.reward.sum(axis=1), seen.there.sum(axis=1)


def show(policy: Exported, settings: Settings) -> int:
    """Prints what `evaluate` finds; the exit status."""
    from vecpsmbpo.evaluate import print_returns

    returns, lengths = evaluate(policy, settings)
    title = f"{settings.task} ({settings.backend}), {policy.path}: mean actions"
    print_returns(title, [({"seed": policy.about.get("seed")}, returns, lengths)])
    return 0
