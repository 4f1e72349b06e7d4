"""Measures the commands that look at runs: CPU seconds and memory against the size of the logs, which are made up.

    python tools/bench_look.py > results/look.csv

`report` reads one run with up to a million episodes, `read` is the reading of it alone; `plot` and `compare` read up to
a hundred runs.
"""

import csv
import json
import os
import random
import subprocess
import sys
import tempfile
from pathlib import Path

from vecpsmbpo import config

EPISODES, RUNS = (250_000, 500_000, 1_000_000), (25, 50, 100)
EPOCHS, SEEDS, MEMBERS = 125, 4, (5, 5)
READ = "import pathlib, sys; from vecpsmbpo.look import runs; runs.load(pathlib.Path(sys.argv[1])).episodes"


def main() -> None:
    writer = csv.writer(sys.stdout, lineterminator="\n")
    writer.writerow(("command", "what", "count", "MiB of logs", "CPU seconds", "peak MiB"))
    with tempfile.TemporaryDirectory() as folder:
        for count in EPISODES:
            run = make(Path(folder) / f"episodes{count}", count)
            for command in ("read", "report"):
                _row(writer, command, "episodes of one run", count, [run])
        runs = [make(Path(folder) / f"run{index}", 500, seed=index) for index in range(max(RUNS))]
        for count in RUNS:
            for command in ("plot", "compare"):
                _row(writer, command, "runs", count, runs[:count])


def make(path: Path, episodes: int, seed: int = 0) -> Path:
    """A run directory with `EPOCHS` epochs and this many episodes of each of its lanes together."""
    path.mkdir()
    algo = "ops_mbpo" if seed % 2 else "ps_mbpo"
    words = ["env=hopper", f"algo={algo}", f"num_seeds={SEEDS}", f"seed={SEEDS * seed}", f"run_dir={path}"]
    config.save(config.compose(words), path)
    drawn, (n, m) = random.Random(seed), MEMBERS
    with (path / "metrics.jsonl").open("w") as file:
        for epoch in range(EPOCHS):
            for lane in range(SEEDS * seed, SEEDS * (seed + 1)):
                score = 3000 * (1 - 0.97**epoch) + drawn.gauss(0, 100)
                line = {"env_steps": 1000 * (epoch + 1), "seed": lane, "eval_return": score, "train_return": score}
                line |= {"critic_loss": drawn.random(), "alpha": 0.1, "entropy": 0.5, "seconds": 60.0 * (epoch + 1)}
                file.write(json.dumps(line) + "\n")
    steps = 1000 * EPOCHS * SEEDS // episodes or 1
    with (path / "episodes.jsonl").open("w") as file:
        for index in range(episodes // SEEDS):
            probs = [[round(drawn.random(), 8) for _ in range(m)] for _ in range(n)]
            for lane in range(SEEDS * seed, SEEDS * (seed + 1)):
                line = {"seed": lane, "episode": index + 1, "env_steps": steps * (index + 1), "model": index % n}
                line |= {"policy": index % m, "return": drawn.gauss(1000, 100), "length": steps, "terminated": False}
                file.write(json.dumps({**line, "truncated": True, "random": False, "probs": probs}) + "\n")
    return path


def _row(writer, command: str, what: str, count: int, runs: list[Path]) -> None:
    """Runs the command in a process of its own and writes what it took."""
    size = sum(path.stat().st_size for run in runs for path in run.glob("*.jsonl"))
    if command == "read":
        words = ["-c", READ, str(runs[0])]
    else:
        out = runs[0].parent / {"plot": "a.png", "compare": "a.csv", "report": "a.html"}[command]
        words = ["-m", "vecpsmbpo.cli", command, *map(str, runs), f"out={out}"]
    process = subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"{command} failed")
    seconds, peak = used.ru_utime + used.ru_stime, used.ru_maxrss / 1024
    writer.writerow((command, what, count, f"{size / 2**20:.0f}", f"{seconds:.1f}", f"{peak:.0f}"))
    sys.stdout.flush()


if __name__ == "__main__":
    main()
