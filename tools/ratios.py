"""Draws a run that chooses λ online beside runs of constant λ: python tools/ratios.py FILE.svg RUN_DIR...

Left: sampled returns, the mean of the last `WINDOW` epochs (band: standard error over seeds). Middle: the members' mean
λ, by seed. Right: how likely each λ is the best, mean over seeds.
"""

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from vecpsmbpo import config, metrics
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.theory.svg import Panel, Series, write

WINDOW = 5  # epochs
ONLINE = "chosen online"
Curves = dict[str, list[list[metrics.Line]]]  # the epochs of every seed, by how λ is found


def _read(run_dir: Path) -> tuple[Settings, Curves]:
    """A run's settings and epochs.

    Raises:
        SettingError: there is no such run, none of its epochs is over, or it is not of the kind that is drawn.
    """
    settings = config.load(run_dir)
    if settings.real_ratio_schedule == "linear" or {name for name, _ in settings.sweep} - {"real_ratio"}:
        raise SettingError(f"run_dir={run_dir}: must have a constant λ or choose it, and sweep nothing else")
    lanes: dict[tuple[str, int], list[metrics.Line]] = defaultdict(list)
    for line in metrics.read(run_dir / metrics.METRICS_FILE):
        lanes[ONLINE if settings.adapts_real_ratio else f"λ = {line['real_ratio']:g}", line["seed"]].append(line)
    if not lanes:
        raise SettingError(f"run_dir={run_dir}: has no epoch yet")
    curves = defaultdict(list)
    for (name, _), lines in lanes.items():
        curves[name].append(lines)
    return settings, curves


def _column(curves: list[list[metrics.Line]], name: str) -> np.ndarray:
    """[S, T, ...] of one field; NaN for null."""
    return np.array([[line[name] for line in lines] for lines in curves], float)


def _returns(name: str, curves: list[list[metrics.Line]]) -> Series:
    """Mean over seeds of the mean of the last `WINDOW` epochs, those left out in which no episode ended."""
    values = _column(curves, "train_return")
    ended = ~np.isnan(values)
    sums, counts = np.cumsum(np.where(ended, values, 0.0), axis=1), np.cumsum(ended, axis=1)
    for x in (sums, counts):
        x[:, WINDOW:] = x[:, WINDOW:] - x[:, :-WINDOW]
    there = (counts > 0).all(axis=0)
    smooth = sums[:, there] / counts[:, there]
    error = smooth.std(axis=0, ddof=1) / np.sqrt(len(curves)) if len(curves) > 1 else None
    return Series(name, _column(curves, "env_steps")[0, there], smooth.mean(axis=0), error)


def panels(run_dirs: list[Path]) -> list[Panel]:
    """The figure's panels.

    Raises:
        SettingError: a run cannot be drawn (`_read`), or not exactly one of them chooses λ.
    """
    runs = [_read(run_dir) for run_dir in run_dirs]
    online = [run for run in runs if ONLINE in run[1]]
    if len(online) != 1:
        raise SettingError("RUN_DIR...: one of the runs, and only one, must have real_ratio_schedule=bandit")
    settings, curves = online[0]
    seeds = curves[ONLINE]
    steps, chances = _column(seeds, "env_steps")[0], _column(seeds, "real_ratio_probs").mean(axis=0)
    x = "environment steps"
    means = [Series(f"seed {lines[0]['seed']}", steps, _column([lines], "real_ratio")[0]) for lines in seeds]
    arms = [
        Series(f"λ = {arm:g}", steps, chance) for arm, chance in zip(settings.real_ratio_arms, chances.T, strict=True)
    ]
    returns = [_returns(*item) for _, curves in runs for item in curves.items()]
    return [
        Panel(f"{settings.task}: sampled return", x, "return", returns),
        Panel("λ chosen", x, "mean λ of the members", means),
        Panel("how likely each is the best", x, "probability", arms),
    ]


def main(arguments: list[str]) -> int:
    if len(arguments) < 2 or not arguments[0].endswith(".svg"):
        print("usage: ratios.py FILE.svg RUN_DIR...", file=sys.stderr)
        return 2
    try:
        write(Path(arguments[0]), "λ chosen online", panels([Path(text) for text in arguments[1:]]), columns=3)
    except SettingError as error:
        print(f"ratios.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
