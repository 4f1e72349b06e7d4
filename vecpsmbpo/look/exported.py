"""A policy that `vecpsmbpo export` has written, where a run would be: `vecpsmbpo.load`, `eval` and `render` take it."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo import config
from vecpsmbpo.settings import SettingError, Settings

Array = np.ndarray

WEIGHTS_FILE, ABOUT_FILE = "policy.npz", "policy.json"
ALONE = ("policy", "actions", "devices")  # what is told of a run's evaluation, and has no meaning for one policy


@dataclass(frozen=True)
class Exported:
    """One policy by itself.

    Attributes:
        path: the directory.
        settings: of the run that it comes from.
        about: what policy.json has beside them: task, run, seed, member, env_steps, ...
        layers: kernel [in, out] and bias [out] of each, in order.
    """

    path: Path
    settings: Settings
    about: Mapping[str, Any]
    layers: list[tuple[Array, Array]]

    def act(self, obs: Any) -> Array:
        """obs [..., O] -> mean action [..., A] in [-1, 1]."""
        hidden = np.asarray(obs, np.float32)
        for kernel, bias in self.layers[:-1]:
            hidden = np.maximum(hidden @ kernel + bias, 0)
        kernel, bias = self.layers[-1]
        return np.tanh(hidden @ kernel + bias)


def is_one(path: str | Path) -> bool:
    return (Path(path) / ABOUT_FILE).is_file()


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
            layers = [(stored[f"kernel_{i}"], stored[f"bias_{i}"]) for i in range(len(stored.files) // 2)]
        if not layers or layers[-1][1].shape != (about["action_size"],):
            raise ValueError("weights of another policy")
    except (OSError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise SettingError(f"{path}: holds no policy that can be read ({type(error).__name__}: {error})") from None
    return Exported(path, replace(config.from_record(record, f"{path}: its {ABOUT_FILE}"), run_dir=""), about, layers)


def evaluate(policy: Exported, given: Mapping[str, Any], seed: int = 0) -> tuple[Array, Array]:
    """Whole episodes of the task, side by side: their returns and lengths, [E] each.

    Args:
        given: `episodes` and `backend`, as of `vecpsmbpo eval`.
        seed: of the environments.

    Raises:
        SettingError: a mistake in `given`, or the task's suite is not installed.
    """
    for name in given:
        if name in ALONE:
            raise SettingError(f"{name}={given[name]}: {policy.path} is one policy and its mean actions, without a run")
    settings = config.for_evaluation(policy.settings, given)

    import jax

    from vecpsmbpo import runtime
    from vecpsmbpo.look import fresh

    runtime.configure(replace(settings, devices=1))
    world = fresh.world(settings, settings.eval_episodes, settings.episode_length, seed)
    certain = np.zeros(settings.eval_episodes)
    seen = fresh.collect(world, lambda t, obs, key: (policy.act(obs), certain), world.length, jax.random.key(seed))
    return seen.reward.sum(axis=1), seen.there.sum(axis=1)


def show(policy: Exported, given: Mapping[str, Any]) -> int:
    """Prints what `evaluate` finds; the exit status."""
    from vecpsmbpo.evaluate import print_returns

    returns, lengths = evaluate(policy, given)
    backend = config.for_evaluation(policy.settings, given).backend
    title = f"{policy.settings.task} ({backend}), {policy.path}: mean actions"
    print_returns(title, [({"seed": policy.about.get("seed")}, returns, lengths)])
    return 0
