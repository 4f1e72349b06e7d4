"""A process that native code ends says where it was; one that ends as it should says nothing."""

import os
import signal
import subprocess
import sys

import pytest

from tests.helpers import environment
from vecpsmbpo import crash, versions

ENDS = {
    "segfault": "ctypes.string_at(0)",
    "abort": "os.abort()",
    "abort in the middle of a line": 'os.write(2, b"terminate called after throwing an instance of \'"); os.abort()',
    "segfault in a thread": "ThreadPoolExecutor().submit(lambda: ctypes.string_at(0)).result()",
    "killed": "os.kill(os.getpid(), signal.SIGKILL)",
    "returns": "pass",
    "exits": "sys.exit(3)",
    "raises": "raise KeyboardInterrupt",
    "leaves at once": "crash.end(); os._exit(2)",
}
PROGRAM = """
import ctypes, os, pathlib, signal, sys
from concurrent.futures import ThreadPoolExecutor
from vecpsmbpo import crash
try:
    with crash.watched():
        crash.doing("making the first state", pathlib.Path("."))
        crash.doing("compiling the training program")
        {end}
except KeyboardInterrupt:
    sys.exit(130)
"""


def run(program: str, cwd) -> subprocess.CompletedProcess:
    arguments = [sys.executable, "-c", program]
    return subprocess.run(arguments, cwd=cwd, env=environment(), capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(
    ("end", "status", "reason", "before"),
    [
        ("segfault", -signal.SIGSEGV, "Segmentation fault", ""),
        ("segfault in a thread", -signal.SIGSEGV, "Segmentation fault", ""),
        ("abort", -signal.SIGABRT, "Aborted", "\n"),
        (
            "abort in the middle of a line",
            -signal.SIGABRT,
            "Aborted",
            "terminate called after throwing an instance of '\n",
        ),
    ],
)
def test_a_crash_ends_in_one_line_and_the_signals_own_status(end, status, reason, before, tmp_path):
    result = run(PROGRAM.format(end=ENDS[end]), tmp_path)
    assert result.returncode == status
    report = tmp_path / "crash.txt"
    assert result.stderr == (
        f"{before}vecpsmbpo: crashed ({reason}) while compiling the training program, with {versions.line()}; "
        f"{crash.ADVICE}; Python's stack is in {report}\n"
    )
    assert reason in report.read_text()
    assert 'File "<string>", line' in report.read_text()


def test_a_process_that_is_killed_is_told_from_one_that_crashed(tmp_path):
    result = run(PROGRAM.format(end=ENDS["killed"]), tmp_path)
    assert result.returncode == -signal.SIGKILL
    assert result.stderr.startswith("vecpsmbpo: was killed, or crashed without a trace, while compiling the training")
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("end", "status"), [("returns", 0), ("exits", 3), ("raises", 130), ("leaves at once", 2)])
def test_nothing_is_said_of_any_other_end(end, status, tmp_path):
    result = run(PROGRAM.format(end=ENDS[end]), tmp_path)
    assert (result.returncode, result.stderr) == (status, "")
    assert not list(tmp_path.iterdir())


def test_the_watcher_outlives_the_signals_that_end_the_process(tmp_path):
    """Control-C goes to both: the process ends as it likes, and the watcher after it."""
    # A shell that starts something in the background has it ignore Control-C, and so would this process.
    heeding = "signal.signal(signal.SIGINT, signal.default_int_handler)"
    program = PROGRAM.format(end=f"{heeding}; print('ready', flush=True); signal.pause()")
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout.readline() == "ready\n"
    os.killpg(process.pid, signal.SIGINT)
    assert process.communicate(timeout=60) == ("", "")
    assert process.returncode == 130


def test_a_program_that_has_jax_already_is_not_forked(tmp_path):
    program = "import os, sys\nfrom vecpsmbpo import crash\nsys.modules['jax'] = None\nos.fork = None\n"
    result = run(f"{program}\nwith crash.watched():\n    crash.doing('x')\n    print('fine')", tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (0, "fine\n", "")


@pytest.mark.parametrize("arguments", [["train", "size=tiny"], ["train", "-m", "seed=0,1", "size=tiny"], ["eval"]])
def test_training_and_evaluating_are_watched(arguments, tmp_path):
    """Where there is nothing to import or compile yet."""
    program = "import ctypes, sys\nfrom vecpsmbpo import cli\ncli._run = cli._eval = lambda _: ctypes.string_at(0)\n"
    result = run(f"{program}\ncli.main({arguments})", tmp_path)
    assert result.returncode == -signal.SIGSEGV
    assert result.stderr.splitlines()[-1].startswith("vecpsmbpo: crashed (Segmentation fault) while starting, with ")
