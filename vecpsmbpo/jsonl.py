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
METRICS_FILE, EPISODES_FILE, SESSIONS_FILE = "metrics.jsonl", "episodes.jsonl", "sessions.jsonl"  # of a run directory
STEP = "env_steps"
INFINITY = "inf"  # in a swept value: JSON has no other
BATCH = 20_000  # lines that are parsed at a time
LARGEST_STEP = 2**53  # a whole number that a float holds, too


def batches(
    file: BinaryIO, needed: Iterable[str] = (STEP,), *, torn: bool = False
) -> Iterator[list[tuple[bytes, Line | None]]]:
    """The lines of an open file, a batch at a time: each as it stands there, and what it says.

    None is a line that is strange: no dictionary, or one without the `needed` numbers. Empty lines are passed over, and
    so is a last one without its end that cannot be read, unless `torn` ones are wanted: it is being written, or was
    when the machine went down.
    """
    needed = tuple(needed)
    while texts := list(islice(file, BATCH)):
        both = zip(texts, _parse(texts, needed), strict=True)
        ended = (b"\n", b"") if torn else b"\n"
        yield [(text, line) for text, line in both if line is not None or (text.strip() and text.endswith(ended))]


def read(path: Path, needed: Iterable[str] = (STEP,)) -> list[Line]:
    """The lines of a file that are not strange; none where there is no file."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        return [line for batch in batches(file, needed) for _, line in batch if line is not None]


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

    def __init__(
        self,
        path: Path,
        env_steps: int,
        needed: Iterable[str],
        mark: Sequence[int] | None,
        warn: Callable,
        *,
        unfinished: bool = False,
    ):
        """Drops lines beyond `env_steps`, and sets strange ones aside in a file beside it.

        Args:
            needed: numbers that a line has.
            mark: of the file when the checkpoint was made, to find what has been lost or changed since.
            warn: is told of it.
            unfinished: whether lines of `env_steps` itself were still to be written then: those after the mark are
                dropped, too.
        """
        self.path, self.written, self.mark = path, 0, (0, 0)
        strange = self._rewind(env_steps, tuple(needed), mark[0] if mark else 0, unfinished)
        lost = max(0, mark[0] - self.mark[0] - strange) if mark else 0
        if strange:
            warn(f"{path}: {strange} line(s) that cannot be read, set aside in {self._aside.name}")
        if lost:
            warn(f"{path}: {lost} of its lines up to step {env_steps} are lost")
        elif mark and not strange and tuple(mark) != self.mark:
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

    def _rewind(self, env_steps: int, needed: tuple[str, ...], written: int, unfinished: bool) -> int:
        """How many lines are strange; so is one of the first `written` that is beyond `env_steps`, or has lost its end.
        (Later ones without an end were being written, and will be again.)"""
        self.path.touch()
        beside, strange, before = self.path.with_suffix(".tmp"), [], 0
        with self.path.open("rb") as file, beside.open("wb") as rewound:
            for batch in batches(file, needed, torn=True):
                kept = []
                for index, (text, line) in enumerate(batch, start=before):
                    if line is None and not text.endswith(b"\n"):
                        if index < written:
                            strange.append(text + b"\n")
                        continue
                    if line is None or (line[STEP] > env_steps and index < written):
                        strange.append(text)
                        continue
                    self.written = max(self.written, line[STEP])
                    again = unfinished and line[STEP] == env_steps and index >= written
                    if line[STEP] <= env_steps and not again:
                        kept.append(text.rstrip(b"\r\n") + b"\n")
                rewound.writelines(kept)
                self._count(kept)
                before += len(batch)
            rewound.flush()
            os.fsync(rewound.fileno())  # or it would be empty, where power fails just after it was moved
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
