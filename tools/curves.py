"""Learning curves of runs as CSV, small enough to commit: python tools/curves.py RUN_DIR... > results/NAME.csv"""

import csv
import sys
from pathlib import Path

from vecpsmbpo import config, metrics
from vecpsmbpo.settings import SettingError

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


def main(run_dirs: list[Path]) -> int:
    try:
        sweeps = [config.load(run_dir).sweep for run_dir in run_dirs]
    except SettingError as error:
        print(f"curves.py: {error}", file=sys.stderr)
        return 2
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("run", "swept", *COLUMNS, "real_ratio_probs"))
    for run_dir, sweep in zip(run_dirs, sweeps, strict=True):
        swept = [name for name, _ in sweep]
        for line in metrics.read(run_dir / metrics.METRICS_FILE):
            lane = " ".join(f"{name}={line[name]}" for name in swept)
            values = (line[name] for name in COLUMNS)
            chances = " ".join(f"{chance:.3f}" for chance in line.get("real_ratio_probs", ()))
            numbers = (f"{v:.5g}" if isinstance(v, float) else v for v in values)
            writer.writerow((run_dir.name, lane, *numbers, chances))
    return 0


if __name__ == "__main__":
    sys.exit(main([Path(text) for text in sys.argv[1:]]))
