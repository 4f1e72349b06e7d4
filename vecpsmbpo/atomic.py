"""Files that are whole or as they were."""

import os
from collections.abc import Callable
from pathlib import Path


def write(path: Path, make: Callable[[Path], object]) -> None:
    """Has `make` write a file beside `path`, of the same kind, and moves it there.

    Raises:
        OSError: it cannot be written; what stood at `path` is as it was.
    """
    beside = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        make(beside)
        with beside.open("rb+") as file:
            os.fsync(file.fileno())  # or it would be empty, where power fails just after it was moved
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """As `write`, of a text."""
    write(path, lambda beside: beside.write_text(text, encoding="utf-8"))
