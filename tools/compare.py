"""Runs of the same length beside each other, as CSV: python tools/compare.py RUN_DIR... [steps=N] > results/NAME.csv

One line per run and swept value, over its seeds:
    eval_last, train_last   mean return of the last `WINDOW` epochs, of mean and of sampled actions: mean over seeds and
                            its standard error
    eval_best               the best evaluation of each seed: mean and standard error
    train_all               mean sampled return of all epochs: how fast it was learned
    seconds                 wall time until then, compilation included
"""

import csv
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from vecpsmbpo import config, metrics
from vecpsmbpo.settings import SettingError

WINDOW = 5  # epochs


def _mean_and_error(values: list[float]) -> tuple[float, float]:
    """Over seeds; the error of a single one is not known."""
    error = np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return float(np.mean(values)), float(error)


def summaries(run_dir: Path, steps: int | None) -> list[dict[str, object]]:
    """A line for each of the run's swept values.

    Raises:
        SettingError: there is no such run, or it ends before `steps`.
    """
    settings = config.load(run_dir)
    lines = metrics.read(run_dir / metrics.METRICS_FILE)
    steps = steps or max((line["env_steps"] for line in lines), default=0)
    if not any(line["env_steps"] == steps for line in lines):
        raise SettingError(f"run_dir={run_dir}: has not come to step {steps}")
    lines = [line for line in lines if line["env_steps"] <= steps]
    swept = [name for name, _ in settings.sweep]
    curves: dict[tuple, dict[int, list[metrics.Line]]] = defaultdict(lambda: defaultdict(list))
    for line in lines:
        curves[tuple(line[name] for name in swept)][line["seed"]].append(line)
    found = []
    for values, seeds in curves.items():
        row: dict[str, object] = {
            "run": run_dir.name,
            "task": settings.task,
            "algo": settings.algo,
            "swept": " ".join(f"{name}={value}" for name, value in zip(swept, values, strict=True)),
            "seeds": len(seeds),
            "env_steps": steps,
        }
        for name, field, take in (
            ("eval_last", "eval_return", lambda x: np.mean(x[-WINDOW:])),
            ("eval_best", "eval_return", np.max),
            ("train_last", "train_return", lambda x: np.mean(x[-WINDOW:])),
            ("train_all", "train_return", np.mean),
        ):
            per_seed = [[line[field] for line in curve if line[field] is not None] for curve in seeds.values()]
            row[name], row[f"{name}_se"] = _mean_and_error([take(curve) if curve else np.nan for curve in per_seed])
        found.append({**row, "seconds": lines[-1]["seconds"]})
    return found


def main(arguments: list[str]) -> int:
    steps = next((int(text.removeprefix("steps=")) for text in arguments if text.startswith("steps=")), None)
    run_dirs = [Path(text) for text in arguments if not text.startswith("steps=")]
    if not run_dirs:
        print("usage: compare.py RUN_DIR... [steps=N]", file=sys.stderr)
        return 2
    try:
        rows = [row for run_dir in run_dirs for row in summaries(run_dir, steps)]
    except SettingError as error:
        print(f"compare.py: {error}", file=sys.stderr)
        return 2
    writer = csv.DictWriter(sys.stdout, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
