"""Processes that are told to end, or killed, and a second one in the directory of a run."""

import random
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

from tools.harm.runs import END, RUN, Found, command, one_line, said_until, same_end, started, undisturbed
from vecpsmbpo import checkpoint

TO_LIVE_S = 10.0


def signals(folder: Path, options: dict) -> Iterator[Found]:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a run inherits what nohup makes of it, and heeds that
    reference = undisturbed(folder, "host")
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        name = signal.Signals(number).name
        process = started(*RUN, "backend=host", f"total_steps={END}", f"run_dir={name}", cwd=folder)
        said_until(process, "step")
        process.send_signal(number)
        try:
            said, errors = process.communicate(timeout=TO_LIVE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            said, errors = process.communicate()
        command(f"run_dir={name}", cwd=folder)
        ended = same_end(folder / name, reference)
        if process.returncode != 128 + number or "to continue: " not in said:
            ended = f"{ended}, but status {process.returncode}: {errors[-200:]!r}"
        yield f"{name}, killed {TO_LIVE_S:.0f} s later", ended


def twice(folder: Path, options: dict) -> Iterator[Found]:
    arguments = (*RUN, "backend=host", f"total_steps={END}", "run_dir=run")
    first = started(*arguments, cwd=folder)
    said_until(first, "compiling")
    first.send_signal(signal.SIGSTOP)
    second = command(*arguments, cwd=folder)
    first.send_signal(signal.SIGCONT)
    first.communicate()
    yield "the second process", one_line(second.returncode, second.stderr)
    yield "the first process", same_end(folder / "run", undisturbed(folder, "host"))


def kills(folder: Path, options: dict) -> Iterator[Found]:
    dice = random.Random(0)
    for backend in ("host", "mjx"):
        reference = undisturbed(folder, backend)  # which compiles, and the runs after it do not
        began = time.perf_counter()
        command(*RUN, f"backend={backend}", f"total_steps={END}", f"run_dir={backend}0", cwd=folder)
        longest, done, runs = time.perf_counter() - began, 0, 0
        while done < options["kills"]:
            runs += 1
            run_dir, before, saving = folder / f"{backend}{runs}", done, 0
            while True:
                process = started(*RUN, f"backend={backend}", f"total_steps={END}", f"run_dir={run_dir}", cwd=folder)
                if done == options["kills"]:
                    process.communicate()
                    break
                if done % 5 == 0 and in_a_save(process, run_dir):
                    saving += 1
                else:
                    try:
                        process.communicate(timeout=dice.uniform(0, longest))
                        break
                    except subprocess.TimeoutExpired:
                        pass
                process.kill()
                process.communicate()
                done += 1
            what = f"{backend}: {done - before} kills of run {runs}, {saving} of them in a save"
            yield what, same_end(run_dir, reference)


def in_a_save(process: subprocess.Popen, run_dir: Path) -> bool:
    """Waits until a checkpoint is being written beside its place; False where the process ends before."""
    while process.poll() is None:
        if any(run_dir.glob(f"{checkpoint.FOLDER}/*orbax-checkpoint-tmp*")):
            return True
        time.sleep(0.001)
    return False
