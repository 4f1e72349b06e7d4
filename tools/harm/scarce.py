"""Too little room on the disk, too little memory, too few files."""

import resource
import subprocess
from collections.abc import Iterator
from pathlib import Path

from tools.harm.runs import (
    END,
    FINE,
    RUN,
    SAME,
    Found,
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


def disk(folder: Path, options: dict) -> Iterator[Found]:
    reference, small = undisturbed(folder, "host"), folder / "disk"
    small.mkdir()
    kinds = [(f"size={size}k", f"{size} KiB") for size in DISKS_KB]
    kinds += [(f"size=64m,nr_inodes={files}", f"{files} files") for files in DISKS_FILES]
    for sizes, what in kinds:
        subprocess.run(["mount", "-t", "tmpfs", "-o", sizes, "tmpfs", small], check=True)
        try:
            arguments = (*RUN, "backend=host", f"total_steps={END}", "run_dir=disk/run")
            result = command(*arguments, cwd=folder)
            ended = SAME if result.returncode == 0 else one_line(result.returncode, result.stderr)
            if ended in FINE:
                subprocess.run(["mount", "-o", "remount,size=64m,nr_inodes=10k", small], check=True)
                command(*arguments, cwd=folder)
                ended = same_end(small / "run", reference)
        finally:
            subprocess.run(["umount", small], check=True)
        yield what, ended


def limits(folder: Path, options: dict) -> Iterator[Found]:
    reference = undisturbed(folder, "host")
    kinds = [(f"{size} MiB", "", resource.RLIMIT_AS, size << 20) for size in MEMORIES_MB]
    kinds += [
        (f"{more} MiB more from {word!r} on", word, resource.RLIMIT_AS, more << 20)
        for word in ("compiling", "step")
        for more in MORE_MB
    ]
    kinds += [(f"{count} open files", "", resource.RLIMIT_NOFILE, count) for count in OPEN_FILES]
    for number, (what, word, kind, amount) in enumerate(kinds):
        arguments = (*RUN, "backend=host", f"total_steps={END}", f"run_dir=limits{number}")
        process = started(*arguments, cwd=folder, limit=None if word else (kind, amount))
        if word:
            said_until(process, word)
            held = int(Path(f"/proc/{process.pid}/statm").read_text().split()[0]) * resource.getpagesize()
            resource.prlimit(process.pid, kind, (held + amount,) * 2)
        errors = errors_of(process)
        ended = SAME if process.returncode == 0 else one_line(process.returncode, errors, expected=None)
        if ended in FINE:
            command(*arguments, cwd=folder)
            ended = same_end(folder / f"limits{number}", reference)
        yield what, ended
