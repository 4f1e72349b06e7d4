"""`bench.py compare`: MBPO's single policy on hopper, here and in mbrl-lib, in turns on one machine.

    python tools/bench.py compare peer=PEER/bin/python [repeats=2]

PEER is a virtual environment of Python 3.11 with, in this order,
    pip install torch==2.13.0
    pip install mbrl==0.2.0
    pip install hydra-core==1.3.2 omegaconf==2.3.0 mujoco==2.3.3 'numpy<2'

Both: five models of 4 × 200, one policy, 100,000 start states every 250 steps, λ = 0.05, rollouts of one step, C
MuJoCo; each fits its models until they stop to improve. Evaluation does not count.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vecpsmbpo import arguments, jsonl
from vecpsmbpo.settings import SettingError

OPTIONS = {
    "peer": arguments.text("the interpreter that has mbrl-lib", allowed="a file"),
    "repeats": arguments.whole("of each, in turns", 2, at_least=1),
}
SAME = {"models": 5, "width": 256, "batch": 256, "updates": 10, "starts": 100_000, "random_steps": 1000}
PERIOD, WARM = 250, 500  # steps between fits; learning steps before those that count
LEARNING_STEPS = WARM + 2 * PERIOD


def compare(words: Sequence[str]) -> dict[str, Any]:
    """Milliseconds of a learning step, fits and rollouts included, and of the updates in it."""
    alone, options = arguments.parse("compare", words, OPTIONS)
    if alone or not Path(options["peer"]).is_file():
        given = f"no file peer={options['peer']}; " * bool(options["peer"])
        raise SettingError(f"compare: {given}it needs peer=, a Python that has mbrl-lib (benches/peer.py says how)")
    theirs, ours = [], []
    for _ in range(options["repeats"]):
        theirs.append(time_peer(options["peer"]))
        ours.append(time_here())
    best_here, best_there = min(ours), min(found["ms_per_step"] for found in theirs)
    return {
        "cpus": os.cpu_count(),
        "task": "hopper",
        **SAME,
        "ours_ms_per_step": ours,
        "mbrl_lib_ms_per_step": [found["ms_per_step"] for found in theirs],
        "mbrl_lib_ms_of_updates": [found["ms_of_updates"] for found in theirs],
        "threads_of_torch": theirs[0]["threads"],
        "times_as_fast": best_there / best_here,
    }


def time_peer(python: str) -> dict[str, float]:
    program = Path(__file__).with_name("peer_mbrl_lib.py")
    words = json.dumps({**SAME, "learning_steps": LEARNING_STEPS})
    done = subprocess.run([python, str(program), words], check=False, stdout=subprocess.PIPE, text=True)
    if done.returncode or not done.stdout:
        raise SettingError(f"compare: peer={python} did not measure mbrl-lib (exit status {done.returncode})")
    found = json.loads(done.stdout.splitlines()[-1])
    seconds = np.array(found["seconds"][WARM:])
    return {
        "ms_per_step": 1e3 * float(seconds.mean()),
        "ms_of_updates": 1e3 * float(np.median(seconds)),
        "threads": found["threads"],
    }


def time_here() -> float:
    """As `train` itself counts it, of its last epoch."""
    with tempfile.TemporaryDirectory() as folder:
        settings = [
            "env=hopper",
            "backend=host",
            "algo=mbpo",
            "recipe=paper",
            f"n_models={SAME['models']}",
            f"policy_hidden_size={SAME['width']}",
            f"policy_batch_size={SAME['batch']}",
            f"updates_per_step={SAME['updates']}",
            f"rollout_starts={SAME['starts']}",
            f"warmup_steps={SAME['random_steps']}",
            f"model_update_every={PERIOD}",
            "epoch_steps=500",
            f"total_steps={SAME['random_steps'] + LEARNING_STEPS}",
            "loggers=[]",
            f"run_dir={folder}/run",
        ]
        subprocess.run([sys.executable, "-m", "vecpsmbpo.cli", "train", *settings], check=True, stdout=sys.stderr)
        last = jsonl.read(Path(folder) / "run" / jsonl.METRICS_FILE)[-1]
    return 1e3 / last["env_steps_per_s"]
