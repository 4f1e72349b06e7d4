"""Run directories that no training made: what the commands that look at runs are tested on."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo import config
from vecpsmbpo.look import compare
from vecpsmbpo.settings import Settings


def epochs(returns: np.ndarray, *, seed: int = 0, epoch: int = 40, **more: Any) -> list[dict]:
    """Lines of metrics.jsonl; `more` is the same in every line."""
    return [
        {
            "env_steps": epoch * (index + 1),
            "seed": seed,
            "eval_return": float(value),
            "train_return": float(value) - 1,
            "critic_loss": None if index == 0 else 1.0 / (index + 1),
            "alpha": 0.1,
            "entropy": 0.5,
            "model_val_mse": 0.2,
            "q_mean": 3.0,
            "real_ratio": 0.5,
            "env_steps_per_s": 10.0,
            "updates_per_s": 100.0,
            "seconds": 2.0 * (index + 1),
            **more,
        }
        for index, value in enumerate(returns)
    ]


def episodes(count: int, members: tuple[int, int] = (2, 2), seed: int = 0, length: int = 25, **more) -> list[dict]:
    """Lines of episodes.jsonl: member `index` acts in turns, the first one is random."""
    n, m = members
    return [
        {
            "seed": seed,
            "episode": index + 1,
            "env_steps": length * (index + 1),
            "model": index % (n * m) // m,
            "policy": index % m,
            "return": float(index),
            "length": length,
            "terminated": False,
            "truncated": True,
            "random": index == 0,
            "probs": np.full((n, m), 1 / (n * m)).tolist(),
            **more,
        }
        for index in range(count)
    ]


@functools.cache
def _compose(overrides: tuple[str, ...]) -> Settings:
    return config.compose(overrides)


def write(path: Path, lines: list[dict], actors: list[dict] = (), **settings: Any) -> Path:
    """A run directory with these logs; settings as on a command line, `size=tiny` unless told otherwise."""
    path.mkdir(parents=True)
    overrides = {"env": "cartpole_swingup", "size": "tiny", **settings}
    composed = _compose(tuple(f"{name}={value}" for name, value in overrides.items()))
    config.save(dataclasses.replace(composed, run_dir=str(path)), path)
    for name, content in (("metrics.jsonl", lines), ("episodes.jsonl", actors)):
        (path / name).write_text("".join(json.dumps(line) + "\n" for line in content))
    return path


def options(**changes: Any) -> dict[str, Any]:
    """What `compare` is told where nothing is said, and `changes`."""
    return {name: option.default for name, option in compare.OPTIONS.items()} | changes
