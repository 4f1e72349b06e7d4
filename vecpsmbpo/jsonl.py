"""Files of JSON lines: read whatever has befallen them, and written so that it is noticed."""

import filecmp
import json
import math
import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

Line = dict[str, Any]
STEP = "env_steps"
INFINITY = "inf"  # in a swept value: JSON has no other
BATCH = 20_000  # lines that are parsed at a time
LARGEST_STEP = 2**53  # a whole number that a float holds, too


def batches(file: BinaryIO, needed: Iterable[str] = (STEP,)) -> Iterator[tuple[list[bytes], list[Line | None]]]:
    """The lines of an open file, a batch at a time: as they stand there, and what they say.

    None is a line that is strange: no dictionary, or one without the `needed` numbers. Empty lines are passed over, and
    so is a last one without its end that cannot be read: it is being written, or was when the machine went down.
    """
    needed = tuple(needed)
    while texts := list(islice(file, BATCH)):
        lines = _parse(texts, needed)
        there = [
            bool(text.strip()) and (line is not None or text.endswith(b"\n"))
            for text, line in zip(texts, lines, strict=True)
        ]
        if not all(there):
            texts, lines = ([item for item, it in zip(items, there, strict=True) if it] for items in (texts, lines))
        yield texts, lines


def read(path: Path, needed: Iterable[str] = (STEP,)) -> list[Line]:
    """The lines of a file that are not strange; none where there is no file."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        return [line for _, lines in batches(file, needed) for line in lines if line is not None]


def _parse(texts: list[bytes], needed: tuple[str, ...]) -> list[Line | None]:
    try:
        lines = json.loads(b"[" + b",".join(texts) + b"]")  # at once: twice as fast as line by line
        if len(lines) == len(texts) and all(_has(line, needed) for line in lines):
            return lines
    except (ValueError, RecursionError):
        pass
    return [_dictionary(text, needed) for text in texts]


def _dictionary(text: bytes, needed: tuple[str, ...]) -> Line | None:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):  # ValueError: also bytes that are no UTF-8
        return None
    return found if _has(found, needed) else None


def _has(line: Any, needed: tuple[str, ...]) -> bool:
    """Whether a line is a dictionary with these numbers; steps are whole ones."""
    if not isinstance(line, dict):
        return False
    if STEP in needed and not (type(line.get(STEP)) is int and 0 <= line[STEP] <= LARGEST_STEP):
        return False
    return all(type(line.get(name)) in (int, float) or line.get(name) == INFINITY for name in needed)


def text_of(line: Line) -> str:
    """A line of a file. JSON has neither NaN nor infinity: they are null."""

    def plain(value: Any) -> Any:
        if isinstance(value, list):
            return [plain(item) for item in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps({name: plain(value) for name, value in line.items()}, allow_nan=False) + "\n"


class Growing:
    """A file that lines are appended to, and that is rewound to a checkpoint by their steps.

    Attributes:
        written: the last step that there was a line of when it was opened, or 0.
        mark: lines and checksum of all that it holds, which the next checkpoint keeps.
    """

    def __init__(self, path: Path, env_steps: int, needed: Iterable[str], mark: Sequence[int] | None, warn: Callable):
        """Drops lines beyond `env_steps`, and sets strange ones aside in a file beside it.

        Args:
            needed: numbers that a line has.
            mark: of the file when the checkpoint was made, to find what has been lost or changed since.
            warn: is told of it.
        """
        self.path, self.written, self.mark = path, 0, (0, 0)
        strange = self._rewind(env_steps, tuple(needed))
        lines, lost = self.mark[0], 0
        if strange:
            warn(f"{path}: {strange} line(s) that cannot be read, set aside in {self._aside.name}")
        if mark is not None:
            lost = max(0, mark[0] - lines - strange)
        if lost:
            warn(f"{path}: {lost} of its lines up to step {env_steps} are lost")
        elif mark is not None and not strange and tuple(mark) != self.mark:
            warn(f"{path}: lines up to step {env_steps} are not as they were written")

    def append(self, lines: Iterable[Line]) -> None:
        """Writes lines, to the disk and not only to the system."""
        text = "".join(map(text_of, lines)).encode()
        with self.path.open("ab") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        self._count([text] if text else [])

    @property
    def _aside(self) -> Path:
        return self.path.with_name(f"{self.path.name}.strange")

    def _rewind(self, env_steps: int, needed: tuple[str, ...]) -> int:
        """How many lines are strange."""
        self.path.touch()
        beside, strange = self.path.with_suffix(".tmp"), []
        with self.path.open("rb") as file, beside.open("wb") as rewound:
            for texts, lines in batches(file, needed):
                strange += [text for text, line in zip(texts, lines, strict=True) if line is None]
                known = [(text, line[STEP]) for text, line in zip(texts, lines, strict=True) if line is not None]
                self.written = max([self.written, *(step for _, step in known)])
                kept = [text.rstrip(b"\r\n") + b"\n" for text, step in known if step <= env_steps]
                rewound.writelines(kept)
                self._count(kept)
        if strange:  # before they are gone from where they were
            with self._aside.open("ab") as file:
                file.writelines(strange)
                os.fsync(file.fileno())
        if filecmp.cmp(beside, self.path, shallow=False):
            beside.unlink()
        else:
            beside.replace(self.path)
        return len(strange)

    def _count(self, texts: list[bytes]) -> None:
        whole = b"".join(texts)
        self.mark = (self.mark[0] + whole.count(b"\n"), zlib.crc32(whole, self.mark[1]))
