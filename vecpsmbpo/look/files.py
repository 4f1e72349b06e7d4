"""What a command writes where it was told to: whole, or one line."""

import contextlib
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from vecpsmbpo import atomic
from vecpsmbpo.settings import SettingError


def write(path: Path, make: Callable[[Path], object]) -> None:
    """As `atomic.write`, in a directory that is made for it.

    Raises:
        SettingError: it cannot be written; what stood at `path` is as it was.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic.write(path, make)
    except OSError as error:
        raise SettingError(f"out={path}: cannot be written ({error.strerror or error})") from None


def write_text(path: Path, text: str) -> None:
    """As `write`, of a text."""
    write(path, lambda beside: beside.write_text(text, encoding="utf-8"))


def write_together(folder: Path, contents: Mapping[str, bytes], without: Iterable[str] = ()) -> None:
    """Writes the files of a folder that belong together, by their names: all of them beside it before the first takes
    its place. Files called as in `without`, which earlier ones of the same kind may have had beside them, are removed.

    Raises:
        SettingError: they cannot be written; what stood in `folder` is as it was.
    """
    is_new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".") as beside:
            for name, content in contents.items():
                with (Path(beside) / name).open("wb") as file:
                    file.write(content)
                    file.flush()
                    os.fsync(file.fileno())  # as in `atomic.write`
            for name in contents:
                (Path(beside) / name).replace(folder / name)
        for name in without:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        if is_new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise SettingError(f"out={folder}: cannot be written ({error.strerror or error})") from None


def check_writable(path: Path) -> None:
    """Says before long work, rather than after it, that its file could not be written.

    Raises:
        SettingError: `path` is a directory, or the nearest directory above it that exists cannot be written.
    """
    above = next(parent for parent in path.absolute().parents if parent.exists())
    if path.is_dir():
        reason = "Is a directory"
    elif not above.is_dir():
        reason = "Not a directory"
    elif not os.access(above, os.W_OK | os.X_OK):
        read_only = hasattr(os, "statvfs") and os.statvfs(above).f_flag & os.ST_RDONLY
        reason = "Read-only file system" if read_only else "Permission denied"
    else:
        return
    raise SettingError(f"out={path}: cannot be written ({reason})")
