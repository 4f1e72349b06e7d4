"""Too little room on the disk, too little memory, too few files."""

import contextlib
import resource
import subprocess
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tools.harm.runs import (
    END,
    FINE,
    RUN,
    SAME,
    NotTried,
    Trial,
    command,
    errors_of,
    one_line,
    said_until,
    same_end,
    started,
    undisturbed,
)

MEMORIES_MB = (200, 600, 1000, 1800, 2600, 3400, 4200, 5000)
MORE_MB = (0, 1, 4, 16, 64, 128, 256)  # than it holds
OPEN_FILES = (8, 16, 24, 32, 48, 64, 96, 128, 256)
DISKS_KB = (64, 400, 800, 1100, 1200, 1300, 1400, 1600, 1800, 2000, 2200, 2400, 2600)
DISKS_FILES = (3, 20, 40, 60, 80, 100, 120, 140, 160, 200)


def disk(folder: Path, options: dict) -> Iterator[Trial]:
    small = folder / "disk"
    small.mkdir()
    with mounted(small, "size=64k"):  # before anything takes long: it may not be possible
        pass
    reference = undisturbed(folder, "host")
    kinds = [(f"size={size}k", f"{size} KiB") for size in DISKS_KB]
    kinds += [(f"size=64m,nr_inodes={files}", f"{files} files") for files in DISKS_FILES]
    for sizes, what in kinds:
        yield what, partial(_filled, small, sizes, reference)
    for words in (["seed=0"], ["-m", "seed=0,1"]):
        yield f"train {' '.join(words)} in a folder that cannot be written", partial(_read_only, small, words)


def _filled(small: Path, sizes: str, reference: Path) -> str:
    with mounted(small, sizes):
        arguments = (*RUN, "backend=host", f"total_steps={END}", f"run_dir={small}/run")
        result = command(*arguments, cwd=small.parent)
        ended = SAME if result.returncode == 0 else one_line(result.returncode, result.stderr)
        if ended in FINE:
            subprocess.run(["mount", "-o", "remount,size=64m,nr_inodes=10k", small], check=True)
            command(*arguments, cwd=small.parent)
            ended = same_end(small / "run", reference)
        return ended


def _read_only(small: Path, words: list[str]) -> str:
    with mounted(small, "ro"):
        result = command(*words, *RUN, "backend=host", cwd=small)
        return one_line(result.returncode, result.stderr)


@contextlib.contextmanager
def mounted(folder: Path, how: str) -> Iterator[None]:
    """A disk of its own, of memory.

    Raises:
        NotTried: that takes root, and a system that knows tmpfs.
    """
    try:
        subprocess.run(["mount", "-t", "tmpfs", "-o", how, "tmpfs", folder], check=True, capture_output=True, text=True)
    except subprocess.CalledProcessError as error:
        raise NotTried(f"disks cannot be mounted here ({error.stderr.strip()})") from None
    except OSError as error:
        raise NotTried(f"disks cannot be mounted here ({error})") from None
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def limits(folder: Path, options: dict) -> Iterator[Trial]:
    if not hasattr(resource, "prlimit"):
        raise NotTried("limits of a process that runs are Linux's")
    reference = undisturbed(folder, "host")
    kinds = [(f"{size} MiB", "", resource.RLIMIT_AS, size << 20) for size in MEMORIES_MB]
    kinds += [
        (f"{more} MiB more from {word!r} on", word, resource.RLIMIT_AS, more << 20)
        for word in ("compiling", "step")
        for more in MORE_MB
    ]
    kinds += [(f"{count} open files", "", resource.RLIMIT_NOFILE, count) for count in OPEN_FILES]
    for number, (what, word, kind, amount) in enumerate(kinds):
        yield what, partial(_limited, folder / f"limits{number}", word, kind, amount, reference)


def _limited(run_dir: Path, word: str, kind: int, amount: int, reference: Path) -> str:
    """From the line on that begins with `word`, or from the start."""
    arguments, folder = (*RUN, "backend=host", f"total_steps={END}", f"run_dir={run_dir}"), run_dir.parent
    process = started(*arguments, cwd=folder, limit=None if word else (kind, amount))
    if word:
        said_until(process, word)
        held = int(Path(f"/proc/{process.pid}/statm").read_text().split()[0]) * resource.getpagesize()
        resource.prlimit(process.pid, kind, (held + amount,) * 2)
    errors = errors_of(process)
    ended = SAME if process.returncode == 0 else one_line(process.returncode, errors, expected=None)
    if ended in FINE:
        command(*arguments, cwd=folder)
        ended = same_end(run_dir, reference)
    return ended
