"""A tiny run, how it is started, and how it has ended."""

import contextlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TextIO

from tests.helpers import argv, without_times
from vecpsmbpo import cli, jsonl

LOGGED = ["size=tiny", "env=ball_in_cup"]  # 40 steps an epoch, a checkpoint each
RUN = [*LOGGED, "loggers=[]"]
STOPPED, END = 120, 160
ANSWER_S = 100
# The last words of C++, LLVM, XLA, and of a Python that has no memory for others.
NATIVE = re.compile(
    r"terminate called|  what\(\):  |LLVM ERROR: |[EF]\d{4} [\d:.]+ +\d+ \w+\.cc:\d+\] "
    r"|Exception ignored in sys\.unraisablehook|MemoryError$"
)
# The end of the line that an abort may have torn; an empty one where it did not.
BEGUN_ANEW = re.compile(r"(^|\n)\n(?=vecpsmbpo: crashed \(Aborted\))")
SAME, SAID, ONE_LINE, SAVED = "same end", "same state, lost lines are said", "one line", "it had begun, and saved"
FINE = (SAME, SAID, ONE_LINE, SAVED)
# What is tried, and what tries it and returns how it ended: one of FINE, or what was wrong.
Trial = tuple[str, Callable[[], str]]


class NotTried(Exception):
    """What this machine lacks for a part."""


def environment() -> dict[str, str]:
    """What users have: without the flags with which tests compile."""
    return {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}


def lines(run_dir: Path) -> list[dict]:
    """Of both logs, without what depends on the clock."""
    return [
        line for name in (jsonl.METRICS_FILE, jsonl.EPISODES_FILE) for line in without_times(jsonl.read(run_dir / name))
    ]


def arrays(run_dir: Path) -> int | None:
    """A checksum of the whole state at the end; None where it has not come to its end."""
    metadata = run_dir / f"checkpoints/{END}/host/metadata"
    return json.loads(metadata.read_text())["arrays"] if metadata.exists() else None


def same_end(run_dir: Path, undisturbed: Path) -> str:
    state = arrays(run_dir)
    if state is None:
        return "not gone on with"
    if state != arrays(undisturbed):
        return "another end"
    return SAME if lines(run_dir) == lines(undisturbed) else "other logs"


def warned_end(errors: str, run_dir: Path, undisturbed: Path) -> str:
    """As `same_end`, of a run that may say nothing on stderr but warnings of its own."""
    others = [line for line in errors.splitlines() if not line.startswith("vecpsmbpo: warning: ")]
    return f"status 0, and besides {' '.join(others)[-200:]!r}" if others else same_end(run_dir, undisturbed)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def one_line(status: int, errors: str, expected: int | None = 2) -> str:
    """`expected`: the exit status; None is any but 0: how a process ends that gets no memory, the system says."""
    if expected is None:
        expected = status or 1
    errors = BEGUN_ANEW.sub(r"\1", errors)
    told = [line for line in errors.splitlines() if line.startswith("vecpsmbpo: ") and "warning" not in line]
    others = [line for line in errors.splitlines() if not line.startswith("vecpsmbpo: ") and not NATIVE.match(line)]
    if (status, len(told), others) == (expected, 1, []):
        return ONE_LINE
    return f"status {status}, {len(told)} line(s), and besides {' '.join(others)[-200:]!r}"


def here(arguments: list[str]) -> tuple[int, str]:
    """A command in this process, which has compiled the program already: its exit status and what it said."""
    with _silenced(1), _silenced(2) as said:
        try:
            status = cli.main(["train", *arguments])
        except BaseException as error:  # the fault that is looked for
            print(repr(error), file=sys.stderr)
            status = -1
        sys.stderr.flush()
        said.seek(0)
        return status, said.read()


@contextlib.contextmanager
def _silenced(descriptor: int) -> Iterator[TextIO]:
    """Where all goes meanwhile that is written to stdout or stderr: also by libraries, which do not ask Python."""
    stream, before = {1: sys.stdout, 2: sys.stderr}[descriptor], os.dup(descriptor)
    stream.flush()
    try:
        with tempfile.TemporaryFile("w+", errors="replace") as file:
            os.dup2(file.fileno(), descriptor)
            yield file
            stream.flush()
    finally:
        os.dup2(before, descriptor)
        os.close(before)


def command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    process = started(*arguments, cwd=cwd)
    said, errors = process.communicate()
    return subprocess.CompletedProcess(arguments, process.returncode, said, errors)


def started(
    *arguments: str,
    cwd: Path,
    limit: tuple[int, int] | None = None,
    one_thread: bool = True,
    surroundings: Mapping[str, str] = MappingProxyType({}),
) -> subprocess.Popen:
    """`limit`: a resource, and how much of it the process may have."""
    pipe, train = subprocess.PIPE, argv("train", *arguments, one_thread=one_thread)
    obey = partial(resource.setrlimit, limit[0], (limit[1],) * 2) if limit else None
    surrounded = {**environment(), **surroundings}
    return subprocess.Popen(train, cwd=cwd, env=surrounded, stdout=pipe, stderr=pipe, text=True, preexec_fn=obey)


def errors_of(process: subprocess.Popen) -> str:
    """What a process said by its end, which is put to it if it does not come by itself."""
    try:
        return process.communicate(timeout=ANSWER_S)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        return process.communicate()[1] + "has not ended"


def said_until(process: subprocess.Popen, word: str) -> None:
    """Waits until a process has begun a line with `word`, or ended."""
    assert process.stdout is not None
    next((line for line in process.stdout if line.startswith(word)), None)


def undisturbed(folder: Path, backend: str, *more: str) -> Path:
    """The run that others are compared with, where it lies; `more` settings have one of their own."""
    run_dir = folder / f"undisturbed_{backend}{len(more) or ''}"
    result = command(*RUN, *more, f"backend={backend}", f"total_steps={END}", f"run_dir={run_dir}", cwd=folder)
    assert result.returncode == 0, result.stderr
    return run_dir
