"""What stands around a run: the lock on its directory, and a disk that cannot be written."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

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
