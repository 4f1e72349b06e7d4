"""What stands around a run: signals that stop it, the lock on its directory, and a disk that cannot be written."""

import contextlib
import dataclasses
import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from vecpsmbpo.settings import SettingError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

# What the operating system says where a file cannot be written.
DISK_ERRORS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
    | {errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG}
    | {errno.ENOENT, errno.EMFILE, errno.ENFILE}
)


class DiskError(Exception):
    """The run directory cannot be written; the last checkpoint is whole."""


@dataclasses.dataclass
class Stop:
    """The signal that asked the run to stop, if one did."""

    requested: int | None = None


@contextlib.contextmanager
def heeding_signals() -> Iterator[Stop]:
    """SIGINT, SIGTERM and SIGHUP ask the run to stop after its chunk; a second one stops it at once. SIGHUP that is
    ignored, as `nohup` has it, stays so.

    Only the main thread of a program may say what signals do; in another one they stay what they are.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: Any) -> None:
        if stop.requested is not None:
            raise KeyboardInterrupt
        stop.requested = number
        try:
            print("\nfinishing this chunk and saving; once more to stop at once", file=sys.stderr, flush=True)
        except OSError:  # the terminal is gone, and must not take the run with it
            _speak_to_nobody()

    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, ask) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _speak_to_nobody() -> None:
    """Whatever is printed from now on is lost."""
    nobody = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nobody, stream)
    os.close(nobody)


@contextlib.contextmanager
def alone_in(run_dir: Path) -> Iterator[None]:
    """Keeps a second process from writing into the same run, as long as this one lives; where there are locks."""
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
    """Turns a disk that cannot be written into one line."""
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise
        reason = os.strerror(error.errno)
    except ValueError as error:  # orbax's storage layer reports a full disk so
        if "No space left" not in str(error) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        reason = os.strerror(errno.ENOSPC)
    else:
        return
    raise DiskError(f"run_dir={run_dir}: cannot be written ({reason})")
