"""What stands around a run: the lock on its directory, logs without checkpoints, a disk that cannot be written, memory
that is not given; and what ends a run that is not a mistake in its settings."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from vecpsmbpo import checkpoint, jsonl, shortages, words
from vecpsmbpo.settings import SettingError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]


class DiskError(Exception):
    """The run directory cannot be written; the last checkpoint is whole."""


class OutOfMemory(Exception):
    """The system gave no more memory; the last checkpoint is whole."""


class TaskFailed(Exception):
    """The task's own code failed; says where, and how to go on from what is saved."""


def check_place(run_dir: str) -> None:
    """Raises:
    SettingError: tensorstore, which writes the checkpoints, would take it for another place.
    """
    if "://" in run_dir or (os.sep != "\\" and "\\" in os.path.abspath(run_dir)):
        raise SettingError(f"run_dir={run_dir}: must be a folder of this machine, without a backslash in its path")


def has_checkpoint(run_dir: Path) -> bool:
    return any(path.name.isdecimal() for path in (run_dir / checkpoint.FOLDER).glob("*"))


def check_not_emptied(run_dir: Path) -> None:
    """Raises:
    SettingError: there are logs of a run, and no checkpoints: beginning anew would write over them.
    """
    if has_checkpoint(run_dir):
        return
    files = (jsonl.METRICS_FILE, jsonl.EPISODES_FILE)
    done = max((line[jsonl.STEP] for name in files for line in jsonl.read(run_dir / name)), default=0)
    if done:
        raise SettingError(
            f"run_dir={run_dir}: its logs reach step {done}, but its checkpoints are gone; put them back, or give "
            "another run_dir"
        )


@contextlib.contextmanager
def alone_in(run_dir: Path) -> Iterator[None]:
    """Keeps a second process from writing into the same run, as long as this one lives; where there are locks.

    Raises:
        SettingError: another one does.
    """
    if fcntl is None:
        yield
        return
    handle = os.open(run_dir, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise SettingError(f"run_dir={run_dir}: another process is training in it") from None
        yield
    finally:
        os.close(handle)


@contextlib.contextmanager
def disk_errors(run_dir: Path) -> Iterator[None]:
    """Turns a disk that cannot be read or written into one line.

    Raises:
        DiskError: it cannot.
    """
    try:
        yield
    except (OSError, ValueError) as error:
        number = shortages.number_of(error)
        if number not in shortages.OF_DISKS:
            raise
        raise DiskError(f"run_dir={run_dir}: cannot be written ({os.strerror(number)})") from None


@contextlib.contextmanager
def memory_errors(run_dir: Path) -> Iterator[None]:
    """Turns memory that is asked for and not given into one line.

    Raises:
        OutOfMemory: it is not given.
    """
    try:
        yield
    except Exception as error:
        if shortages.number_of(error) != errno.ENOMEM:
            raise
        raise OutOfMemory(
            f"run_dir={run_dir}: out of memory ({words.of(error)}); what was saved is whole: the same command goes on"
        ) from None
