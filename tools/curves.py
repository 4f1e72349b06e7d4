"""Learning curves of runs as CSV, small enough to commit: python tools/curves.py RUN_DIR... > results/NAME.csv"""

import csv
import sys
from pathlib import Path

from vecpsmbpo import config, metrics

COLUMNS = (
    "env_steps",
    "seed",
    "train_return",
    "eval_return",
    "real_ratio",
    "q_mean",
    "critic_loss",
    "alpha",
    "seconds",
)


def main() -> None:
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("run", "swept", *COLUMNS))
    for run_dir in map(Path, sys.argv[1:]):
        swept = [name for name, _ in config.load(run_dir).sweep]
        for line in metrics.read(run_dir / metrics.METRICS_FILE):
            lane = " ".join(f"{name}={line[name]}" for name in swept)
            values = (line[name] for name in COLUMNS)
            writer.writerow((run_dir.name, lane, *(f"{v:.5g}" if isinstance(v, float) else v for v in values)))


if __name__ == "__main__":
    main()
