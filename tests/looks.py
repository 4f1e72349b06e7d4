"""Run directories that no training made: what the commands that look at runs are tested on."""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo import config
from vecpsmbpo.look import compare, diagnostics
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


def diagnosis(checkpoints: int = 1, *, n_models: int = 2, horizon: int = 4, obs_size: int = 2) -> dict[str, Any]:
    """What `diagnose` writes of a run: errors of 0.2 where 0.1 was expected."""
    sizes = (n_models, horizon, obs_size + 1)
    errors = {"error": np.full(sizes, 0.2), "expected": np.full(sizes, 0.1), "no_change": np.ones(sizes[1:])}
    errors["disagreement"] = np.full(sizes[1:], 0.05)
    critics = {"q": 2.0, "earned": 1.5, "bias": 0.5, "spread_of_bias": 0.1}
    return diagnostics.finite(
        {
            "task": "cartpole_swingup",
            "lane": {"seed": 0},
            "episodes": 1,
            "env_steps": 120,
            "models": {
                "dimensions": ["obs 0", "obs 1", "reward"],
                "spread": np.ones(obs_size + 1),
                **errors,
                "relative": {name: values[..., 0] for name, values in errors.items()},
                "levels": (0.5, 0.9),
                "coverage": np.full((n_models, 2, obs_size + 1), 0.7),
                "histogram": np.ones((n_models, 5)),
                "reliability": {name: np.full((n_models, 3), 0.1) for name in ("expected", "made")},
            },
            "critics": {
                "members": ["0,0", "1,0"],
                "states": 2,
                "discount": 0.99,
                **critics,
                "shown": {"member": [0, 1], "q": [1.0, 2.0], "earned": [1.0, 2.0]},
            },
            "states": {
                "method": "UMAP",
                "real": [[0.0, 1.0]],
                "imagined": [[1.0, 0.0]],
                "distance": {"imagined": 0.1, "fresh": 0.2},
            },
            "history": [
                {"env_steps": 40 * index, "critics": critics, "errors": [0.2, 0.2]} for index in range(checkpoints)
            ],
        }
    )


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
