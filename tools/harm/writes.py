"""Writes of a run that fail once."""

import errno
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from itertools import cycle
from pathlib import Path

from tools.harm.runs import (
    END,
    LOGGED,
    ONE_LINE,
    NotTried,
    Trial,
    errors_of,
    here,
    one_line,
    same_end,
    started,
    warned_end,
)

SHIM = Path(__file__).with_name("writes.c")
ERRORS = (errno.ENOSPC, errno.EIO)
# With a logger, which writes, too; and on all cores, as the runs of this process that go on.
LOGGING = [*LOGGED, "loggers=[tensorboard]", "backend=host", f"total_steps={END}"]


def writes(folder: Path, options: dict) -> Iterator[Trial]:
    if sys.platform != "linux" or shutil.which("gcc") is None:
        raise NotTried("needs gcc and Linux's LD_PRELOAD")
    shim, reference = folder / "writes.so", folder / "reference"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O2", "-o", shim, SHIM, "-ldl"], check=True)
    assert _begun(shim, reference) == (0, "")
    seen = Path(f"{reference}.log").read_text().splitlines()
    chosen = _chosen([_kind_of_write(line) for line in seen], options["writes"])
    print(f"writes: {len(seen)} of an undisturbed run, {len(chosen)} of them tried", flush=True)
    for number, what, error in chosen:
        attempt = partial(_disturbed, shim, folder / "disturbed", number, error, reference)
        yield f"{what} fails with {errno.errorcode[error]}", attempt


def _begun(shim: Path, run_dir: Path, **told: int) -> tuple[int, str]:
    """Exit status and stderr."""
    surroundings = {"LD_PRELOAD": str(shim), "WRITES_BELOW": str(run_dir), "WRITES_LOG": f"{run_dir}.log"}
    surroundings |= {f"WRITES_{name.upper()}": str(value) for name, value in told.items()}
    process = started(*LOGGING, f"run_dir={run_dir}", cwd=run_dir.parent, one_thread=False, surroundings=surroundings)
    errors = errors_of(process)
    return process.returncode, errors


def _disturbed(shim: Path, run_dir: Path, number: int, error: int, reference: Path) -> str:
    status, errors = _begun(shim, run_dir, fail=number, error=error)
    if status == 0:
        ended = warned_end(errors, run_dir, reference)
    else:
        ended = one_line(status, errors)
        if ended == ONE_LINE:
            status, errors = here([*LOGGING, f"run_dir={run_dir}"])
            ended = same_end(run_dir, reference) if status == 0 else f"not gone on with: {errors[-200:]!r}"
    shutil.rmtree(run_dir, ignore_errors=True)
    return ended


def _kind_of_write(line: str) -> str:
    """Of `write checkpoints/120.orbax-checkpoint-tmp/state/real.0/0.0`: `write checkpoints/state/array/part`. Other
    numbers are processes and times."""
    what, path = line.split(maxsplit=1)
    parts = [part.partition(".orbax-checkpoint-tmp")[0] for part in Path(path).parts]
    inside = parts.index("state") + 1 if "state" in parts else len(parts)
    if len(parts) > inside and not parts[inside].startswith(("_", "commit", "manifest")):
        parts[inside:] = ["array", *(re.sub(r"^\d[\d.]*", "part", name) for name in parts[inside + 1 :])]
    kind = "/".join(part for part in parts if not part.isdigit())
    return f"{what} {re.sub(r'[0-9]+', '#', kind) or '.'}"


def _chosen(kinds: list[str], more: int) -> list[tuple[int, str, int]]:
    """Writes by their numbers, from 1; what each is called in the table; and the error that it fails with. The errors
    alternate; each kind that no full disk meets so meets it at its first, too."""
    found: dict[int, str] = {}
    numbers: dict[str, list[int]] = {}
    for number, kind in enumerate(kinds, start=1):
        numbers.setdefault(kind, []).append(number)
    for name in ("first", "middle", "last"):  # of all kinds: a part that is stopped has tried each
        for kind, own in numbers.items():
            number = own[{"first": 0, "middle": len(own) // 2, "last": -1}[name]]
            found.setdefault(number, f"{kind}, {name} of {len(own)}")
    full = {kinds[number - 1] for number, error in zip(found, cycle(ERRORS)) if error == errno.ENOSPC}
    dice = random.Random(0)
    for way in sorted(dice.random() for _ in range(more)):  # not by kind: orbax's threads take turns as they like
        found.setdefault(1 + int(way * len(kinds)), f"what is written {way:.1%} of the way")
    chosen = [(number, what, error) for (number, what), error in zip(found.items(), cycle(ERRORS))]
    firsts = [own[0] for kind, own in numbers.items() if kind not in full]
    return [*chosen, *((number, found[number], errno.ENOSPC) for number in firsts)]
