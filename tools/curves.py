"""Learning curves of runs as CSV, small enough to commit: python tools/curves.py RUN_DIR... > results/NAME.csv"""

import csv
import sys
from pathlib import Path

from vecpsmbpo import metrics

COLUMNS = ("env_steps", "seed", "train_return", "eval_return", "q_mean", "critic_loss", "alpha", "seconds")


def main() -> None:
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("run", *COLUMNS))
    for run_dir in sys.argv[1:]:
        for line in metrics.read(Path(run_dir) / metrics.METRICS_FILE):
            values = (line[name] for name in COLUMNS)
            writer.writerow((Path(run_dir).name, *(f"{v:.5g}" if isinstance(v, float) else v for v in values)))


if __name__ == "__main__":
    main()
