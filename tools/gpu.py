"""All that a GPU has to show, in order of worth, each part with a limit of its own; at most half an hour in one call.

    tools/gpu                          every part, from the first
    tools/gpu hopper_stable updates    these
    tools/gpu minutes=9                so long, all parts together: what is left goes on at the next call
    tools/gpu size=tiny                on any machine, in minutes: that the script itself works
    tools/gpu out=results/gpu          where the figures go (size=tiny: runs/gpu_tiny); the runs lie in out/runs

A part that trains stops at its limit with a checkpoint and goes on from there; a part that measures is done once, and
again where its file in `out` is removed. Each part leaves `<part>.json` (the command, the machine, what came out), and
one that trains its curve besides, `<part>.csv`. The limits of all parts are more than half an hour together, and the
first run may need two calls: at 41,000 updates per second the 500 of each of its 35,000 learning steps take 7 minutes.
"""

import contextlib
import csv
import functools
import json
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools import provenance
from vecpsmbpo import arguments, jsonl
from vecpsmbpo.settings import SettingError

HERE = Path(__file__).resolve().parent
SAVING_S = 90  # that a run is given to save after it was asked to stop
INTERRUPTED = 128 + signal.SIGINT
TINY = {"size": "tiny", "total_steps": "80", "epoch_steps": "40", "replay_capacity": "1000"}


@dataclass(frozen=True)
class Part:
    """A command, and how long it may take.

    Attributes:
        words: of `vecpsmbpo train` where it trains, else of the tool that it names first.
        tiny: with `size=tiny`, instead of the `words` of a tool.
        trains: whether it is a run.
    """

    name: str
    minutes: float
    words: tuple[str, ...]
    tiny: tuple[str, ...] = ()
    trains: bool = False


def _updates(name: str, *settings: str) -> Part:
    """Updates per second of the paper's members, with `settings`."""
    bench, paper = ("bench.py", "updates"), ("n_models=5", "n_policies=5", "updates_per_step=20")
    return Part(name, 1.5, (*bench, *paper, *settings), (*bench, "size=tiny", *settings))


# The original simulator steps: on an H100 a step of MJX costs 10 ms, of C MuJoCo 0.3 (results/gpu/bench_envs.jsonl).
PAPER = ("env=hopper", "backend=host", "total_steps=40000", "seed=0")
PARTS = (
    Part("hopper_stable", 9, (*PAPER, "recipe=stable"), trains=True),
    Part("hopper_paper", 9, (*PAPER, "recipe=paper"), trains=True),
    _updates("updates"),
    _updates("updates_of_ten_seeds", "num_seeds=10"),
    _updates("updates_float32", "network_precision=float32"),
    _updates("updates_bfloat16", "network_precision=bfloat16"),
    _updates("updates_of_ten_seeds_bfloat16", "num_seeds=10", "network_precision=bfloat16"),
    _updates("updates_of_ten_seeds_float32", "num_seeds=10", "network_precision=float32"),
    Part("hosted", 1.5, ("bench.py", "hosted", "size=paper"), ("bench.py", "hosted", "size=tiny", "warmup_steps=80")),
    Part("steps_of_hopper", 2, ("bench.py", "envs", "hopper"), ("bench.py", "envs", "cartpole_swingup")),
    Part("steps_of_ant", 2, ("bench.py", "envs", "ant"), ("bench.py", "envs", "cartpole_swingup")),
    Part(  # leaves parity_again.csv
        "parity",
        2,
        ("parity.py", "hopper", "states=500", "episodes=5"),
        ("parity.py", "cartpole_swingup", "states=50", "episodes=2"),
    ),
    Part("ant_stable", 9, ("env=ant", "backend=host", "total_steps=40000", "seed=0", "recipe=stable"), trains=True),
)


OPTIONS = {
    "out": arguments.out("where the figures go; else results/gpu, or with size=tiny runs/gpu_tiny", ""),
    "size": arguments.choice("of the programs that are run", "paper", "tiny"),
    "minutes": arguments.number("all parts together", 30.0, above=0),
}


def main(words: Sequence[str]) -> int:
    wanted, options = arguments.parse("gpu", words, OPTIONS)
    for name in wanted:
        if name not in (part.name for part in PARTS):
            raise SettingError(f"{name}: no such part; one of {', '.join(part.name for part in PARTS)}")
    wanted = wanted or [part.name for part in PARTS]
    tiny = options["size"] == "tiny"
    out = options["out"] or Path("runs/gpu_tiny" if tiny else "results/gpu")
    if not tiny and device() == "cpu":  # where these parts would take days, and their figures the place of a GPU's
        raise SettingError("JAX sees no GPU here; size=tiny tries the script on a CPU")
    out.mkdir(parents=True, exist_ok=True)
    ends = time.monotonic() + 60 * options["minutes"]
    failed = 0
    for part in PARTS:
        if part.name not in wanted:
            continue
        seconds = None if tiny else min(60 * part.minutes, ends - time.monotonic())
        if seconds is not None and seconds < (SAVING_S if part.trains else 60 * part.minutes):
            print(f"{part.name}: no time left; call this again", flush=True)
            continue
        done = (train if part.trains else measure)(part, out, seconds, tiny)
        print(f"{part.name}: {done}", flush=True)
        failed |= done.startswith("FAILED")
    return int(failed)


def train(part: Part, out: Path, seconds: float | None, tiny: bool) -> str:
    """Begins or goes on with a run, for so many seconds (None: as it needs); what became of it."""
    run_dir = out / "runs" / part.name
    words = dict(word.split("=", 1) for word in part.words) | (TINY if tiny else {})
    settings = [f"{name}={value}" for name, value in words.items()]
    command = [sys.executable, "-m", "vecpsmbpo.cli", "train", *settings, f"run_dir={run_dir}"]
    began = time.monotonic()
    process = subprocess.Popen(command, stdout=sys.stderr)
    try:
        status = process.wait(seconds and max(seconds - SAVING_S, 1))
    except subprocess.TimeoutExpired:
        status = stopped(process)
    lines = [line for line in jsonl.read(run_dir / jsonl.METRICS_FILE) if line["eval_return"] is not None]
    if not lines:
        return "to go on, before its first epoch" if status == INTERRUPTED else f"FAILED with status {status}"
    last, evaluated = lines[-1], [line["eval_return"] for line in lines]
    keep(
        part,
        out,
        command,
        {
            "status": status,
            "env_steps": last["env_steps"],
            "seconds": last["seconds"],
            "seconds_of_this_call": time.monotonic() - began,
            "eval_return_of_the_last_five": sum(evaluated[-5:]) / len(evaluated[-5:]),
            "best_eval_return": max(evaluated),
            "env_steps_per_s": last["env_steps_per_s"],
            "updates_per_s": last["updates_per_s"],
            "compile_seconds": last["compile_seconds"],
        },
    )
    curve = [sys.executable, "-m", "vecpsmbpo.cli", "plot", str(run_dir), f"out={out / part.name}.csv"]
    drawn = subprocess.run(curve, stdout=sys.stderr, check=False)
    if drawn.returncode or status not in (0, INTERRUPTED):
        return f"FAILED with status {status}"
    left = "to go on" if status else "whole"
    return f"{last['env_steps']} steps, {left}; return {last['eval_return']:.4g}"


def stopped(process: subprocess.Popen) -> int:
    """Asks a run to save and end, and ends it where it does not; its exit status."""
    process.send_signal(signal.SIGINT)
    try:
        return process.wait(SAVING_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def measure(part: Part, out: Path, seconds: float | None, tiny: bool) -> str:
    """Runs a tool once, for so many seconds at most (None: as it needs); what became of it."""
    if (out / f"{part.name}.json").exists():
        return "was measured before"
    tool, *words = part.tiny if tiny else part.words
    table = out / f"{part.name}_again.csv"  # parity.csv is the whole one
    if tool == "parity.py":
        words.append(f"output={table}")
    command = [sys.executable, str(HERE / tool), *words]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, timeout=seconds, check=False)
    except subprocess.TimeoutExpired as cut:
        if found := _measured(cut.stdout):
            keep(part, out, command, {"found": found}, ending="_cut")
        return f"FAILED: took longer than {seconds:.0f} s" + f"; {part.name}_cut.json has what it found" * bool(found)
    if done.returncode:
        return f"FAILED with status {done.returncode}"
    found = _measured(done.stdout)
    if tool == "parity.py":
        with table.open() as file:
            found = list(csv.DictReader(file))
    keep(part, out, command, {"found": found})
    (out / f"{part.name}_cut.json").unlink(missing_ok=True)
    return f"{len(found)} lines"


def _measured(printed: bytes | None) -> list[dict[str, Any]]:
    """The lines of a tool that have figures; the last one may have been cut."""
    found = []
    for line in (printed or b"").decode(errors="replace").splitlines():
        if line.startswith("{"):
            with contextlib.suppress(ValueError):
                found.append(json.loads(line))
    return found


def keep(part: Part, out: Path, command: list[str], found: dict[str, Any], ending: str = "") -> None:
    """Writes a part's file."""
    about = {"command": " ".join(["python", *command[1:]]), **provenance.everything(), "device": device()}
    (out / f"{part.name}{ending}.json").write_text(json.dumps({**about, **found}, indent=1) + "\n")


@functools.cache
def device() -> str:
    """What JAX runs on, asked in a process of its own: one that opens a GPU holds most of its memory until it ends."""
    ask = "import jax; print(jax.devices()[0].device_kind)"
    asked = subprocess.run([sys.executable, "-c", ask], stdout=subprocess.PIPE, text=True, check=False)
    return asked.stdout.strip() or "unknown"


if __name__ == "__main__":
    sys.exit(arguments.as_tool("gpu", main, __doc__, OPTIONS))
