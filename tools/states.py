"""Lays the states that runs of one task have visited out in a common plane (figures 8, 18 and 19).

    python tools/states.py runs/x runs/y > states.csv

One line per state: run, lane (seed and swept values), env_steps (when it was visited), x, y (UMAP). The states are D_E
of each run's newest checkpoint, thinned to `ROWS` per run and lane. Needs umap-learn: pip install 'vecpsmbpo[umap]'.
"""

import csv
import importlib.util
import sys
from collections.abc import Iterator

import numpy as np

from vecpsmbpo import config, runtime
from vecpsmbpo.evaluate import restore
from vecpsmbpo.settings import SettingError

ROWS = 2000


def visited(run_dir: str) -> Iterator[tuple[str, str, int, np.ndarray]]:
    """(run, seed and swept values, env_steps, observation [O]) of every state kept, oldest first."""
    settings = config.load(run_dir)
    runtime.configure(settings)
    driver, saved = restore(settings)
    rings = np.asarray(saved.state.seeds.real)
    oldest = max(0, saved.step - rings.shape[1])
    steps = np.unique(np.linspace(oldest, saved.step - 1, ROWS).astype(int))
    size = driver.algorithm.spec.obs_size
    for lane, ring in zip(settings.lanes, rings, strict=True):
        named = " ".join(f"{name}={value:g}" for name, value in lane.items())
        yield from ((run_dir, named, int(step), ring[step % len(ring), :size]) for step in steps)


def main(run_dirs: list[str]) -> int:
    if not run_dirs:
        print("usage: states.py RUN_DIR ...", file=sys.stderr)
        return 2
    if importlib.util.find_spec("umap") is None:
        print("states.py: needs umap-learn; pip install 'vecpsmbpo[umap]'", file=sys.stderr)
        return 2
    try:
        tasks = {config.load(run_dir).task for run_dir in run_dirs}
        if len(tasks) > 1:
            raise SettingError(f"all runs must be of one task, not of {', '.join(sorted(tasks))}")
        states = [state for run_dir in run_dirs for state in visited(run_dir)]
    except SettingError as error:
        print(f"states.py: {error}", file=sys.stderr)
        return 2
    import umap

    obs = np.stack([obs for *_, obs in states])
    spread = obs.std(axis=0)
    plane = umap.UMAP(random_state=0).fit_transform((obs - obs.mean(axis=0)) / np.where(spread > 0, spread, 1.0))
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(["run", "lane", "env_steps", "x", "y"])
    for (run, lane, step, _), (x, y) in zip(states, plane, strict=True):
        writer.writerow([run, lane, step, f"{x:.4f}", f"{y:.4f}"])
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
