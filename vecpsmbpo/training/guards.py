"""What stands around a run: the lock on its directory, a disk that cannot be written, memory that is not given."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from vecpsmbpo import words
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


class OutOfMemory(Exception):
    """The system gave no more memory; the last checkpoint is whole."""


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


@contextlib.contextmanager
def memory_errors(run_dir: Path) -> Iterator[None]:
    """Turns memory that is asked for and not given into one line."""
    try:
        yield
    except (MemoryError, SystemError, RuntimeError, OSError) as error:
        if not _is_out_of_memory(error):
            raise
        raise OutOfMemory(
            f"run_dir={run_dir}: out of memory ({words.of(error)}); what was saved is whole: the same command goes on"
        ) from None


def _is_out_of_memory(error: Exception) -> bool:
    """Python, its extensions, threads, the system and XLA each have their own way to say it."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    if isinstance(error, RuntimeError):  # JAX's errors are of it
        return any(told in str(error) for told in ("can't start new thread", "RESOURCE_EXHAUSTED", "Out of memory"))
    return isinstance(error, MemoryError) or "without exception set" in str(error)
