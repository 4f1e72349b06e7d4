"""Processes that are told to end, or killed, and a second one in the directory of a run."""

import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tools.harm.runs import (
    END,
    ONE_LINE,
    RUN,
    SAME,
    SAVED,
    Trial,
    command,
    one_line,
    said_until,
    same_end,
    started,
    undisturbed,
)
from vecpsmbpo import checkpoint

TO_LIVE_S = 10.0
LONG_EVALUATION = ("eval_episodes=20", "episode_length=1000", "train_episode_length=25")  # of some seconds
# After the start of a process: Python itself is up by the first, and on most machines training begins after the last.
IMPORTING_S = (0.4, 0.6, 0.8, 1.0, 1.3, 1.6, 2.0, 2.5)
KILLS = 5  # of a trial


def signals(folder: Path, options: dict) -> Iterator[Trial]:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a run inherits what nohup makes of it, and heeds that
    reference = undisturbed(folder, "host")
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        name = signal.Signals(number).name
        yield f"{name}, killed {TO_LIVE_S:.0f} s later", partial(_asked_to_stop, folder / name, number, reference)
    reference = undisturbed(folder, "host", *LONG_EVALUATION)
    attempt = partial(_asked_to_stop, folder / "evaluating", signal.SIGTERM, reference, *LONG_EVALUATION)
    yield f"SIGTERM in an evaluation, killed {TO_LIVE_S:.0f} s later", attempt
    for after in IMPORTING_S:
        yield f"SIGINT {after} s after the start", partial(_interrupted, folder, after)


def _asked_to_stop(run_dir: Path, number: signal.Signals, reference: Path, *more: str) -> str:
    folder = run_dir.parent
    process = started(*RUN, *more, "backend=host", f"total_steps={END}", f"run_dir={run_dir}", cwd=folder)
    said_until(process, "step")
    if more:
        time.sleep(2)  # into the first evaluation
    process.send_signal(number)
    try:
        said, errors = process.communicate(timeout=TO_LIVE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        said, errors = process.communicate()
    met = not more or _is_to_evaluate(run_dir)
    command(f"run_dir={run_dir}", cwd=folder)
    ended = same_end(run_dir, reference)
    if not met:
        ended = f"{ended}, but it met no evaluation"
    if process.returncode != 128 + number or "to continue: " not in said:
        ended = f"{ended}, but status {process.returncode}: {errors[-200:]!r}"
    return ended


def _is_to_evaluate(run_dir: Path) -> bool:
    """Whether the newest checkpoint was saved in an evaluation. What a killed save left is none."""
    saved = [path for path in (run_dir / checkpoint.FOLDER).iterdir() if path.name.isdecimal()]
    newest = max(saved, key=lambda path: int(path.name))
    return bool(json.loads((newest / "host" / "metadata").read_text())["to_evaluate"])


def _interrupted(folder: Path, after_s: float) -> str:
    process = started(*RUN, "backend=host", "run_dir=early", cwd=folder)
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate()
    if not (folder / "early").exists():
        return one_line(process.returncode, errors, expected=130)
    shutil.rmtree(folder / "early")  # a fast machine: it trained already, and had to save
    saved = process.returncode == 128 + signal.SIGINT and "to continue: " in said
    return SAVED if saved else f"status {process.returncode}: {errors[-200:]!r}"


def twice(folder: Path, options: dict) -> Iterator[Trial]:
    yield "a second process is refused, and the first one not disturbed", partial(_second, folder)


def _second(folder: Path) -> str:
    arguments = (*RUN, "backend=host", f"total_steps={END}", "run_dir=run")
    first = started(*arguments, cwd=folder)
    said_until(first, "compiling")
    first.send_signal(signal.SIGSTOP)
    second = command(*arguments, cwd=folder)
    first.send_signal(signal.SIGCONT)
    first.communicate()
    ended = one_line(second.returncode, second.stderr)
    return same_end(folder / "run", undisturbed(folder, "host")) if ended == ONE_LINE else ended


def kills(folder: Path, options: dict) -> Iterator[Trial]:
    for backend in ("host", "mjx"):
        run = (*RUN, f"backend={backend}", f"total_steps={END}")
        reference = undisturbed(folder, backend)  # which compiles, and the runs after it do not
        began = time.perf_counter()
        command(*run, f"run_dir={backend}", cwd=folder)
        longest = time.perf_counter() - began
        for done in range(0, options["kills"], KILLS):
            of = range(done + 1, min(done + KILLS, options["kills"]) + 1)
            what = f"{backend}: kills {of[0]} to {of[-1]}, the first in a save"
            yield what, partial(_killed, folder / f"{backend}{done}", run, len(of), longest, reference)


def _killed(run_dir: Path, run: tuple[str, ...], count: int, longest: float, reference: Path) -> str:
    """So many times, in as many runs as that takes; all of them have to end well."""
    dice, done, number, ended = random.Random(run_dir.name), 0, 0, SAME
    while done < count and ended == SAME:
        number += 1
        own = run_dir.with_name(f"{run_dir.name}_{number}")
        again = (*run, f"run_dir={own}")
        while done < count and _kill(started(*again, cwd=own.parent), own, dice.uniform(0, longest), done == 0):
            done += 1
        if done == count:
            command(*again, cwd=own.parent)
        ended = same_end(own, reference)
    return ended


def _kill(process: subprocess.Popen, run_dir: Path, after_s: float, in_a_save: bool) -> bool:
    """False where the process ends before."""
    if in_a_save:
        if not _saving(process, run_dir):
            return False
    else:
        try:
            process.communicate(timeout=after_s)
            return False
        except subprocess.TimeoutExpired:
            pass
    process.kill()
    process.communicate()
    return True


def _saving(process: subprocess.Popen, run_dir: Path) -> bool:
    """Waits until a checkpoint is being written beside its place; False where the process ends before."""
    while process.poll() is None:
        if any(run_dir.glob(f"{checkpoint.FOLDER}/*orbax-checkpoint-tmp*")):
            return True
        time.sleep(0.001)
    return False
