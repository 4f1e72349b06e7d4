"""What the system does not give: memory, open files, room on a disk. Python, its extensions, tensorstore and XLA each
have their own way to say so."""

import errno
import re

# What stands in the way of reading a file and says nothing of what is in it.
NOT_READ = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO, errno.ESTALE, errno.EACCES, errno.EPERM})
# What the operating system says where a file cannot be read or written.
OF_DISKS = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.ESTALE}
    | {errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST, errno.EISDIR, errno.ENAMETOOLONG}
    | {errno.ENOENT, errno.EMFILE, errno.ENFILE}
)
_TENSORSTORES = re.compile(r"os_error_code='(\d+)'")


def number_of(error: BaseException) -> int | None:
    """The operating system's number (`errno`) for what an exception is about; None where it is about something else."""
    if isinstance(error, OSError):
        return error.errno
    said = str(error)
    if found := _TENSORSTORES.search(said):
        return int(found[1])
    if isinstance(error, ValueError):  # orbax's storage layer
        return errno.ENOSPC if "No space left" in said or "RESOURCE_EXHAUSTED" in said else None
    if isinstance(error, RuntimeError):  # threads; XLA's errors are of it, too
        short = any(told in said for told in ("can't start new thread", "RESOURCE_EXHAUSTED", "Out of memory"))
    else:  # an extension that was given no memory may have nothing left to say it with
        short = isinstance(error, MemoryError) or (isinstance(error, SystemError) and "without exception set" in said)
    return errno.ENOMEM if short else None
