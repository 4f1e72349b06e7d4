"""Writes of a run that fail once."""

import errno
import random
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from tools.harm.runs import END, ONE_LINE, RUN, Found, errors_of, here, one_line, same_end, started

SHIM = Path(__file__).with_name("writes.c")


def writes(folder: Path, options: dict) -> Iterator[Found]:
    if shutil.which("gcc") is None:
        print("writes: not tried: there is no gcc here")
        return
    shim = folder / "writes.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-O2", "-o", shim, SHIM, "-ldl"], check=True)
    # With a logger, which writes, too; and on all cores, as the runs of this process that go on.
    run = [*RUN[:-1], "loggers=[tensorboard]", "backend=host", f"total_steps={END}"]

    def begun(run_dir: Path, **told: object) -> tuple[int, str]:
        surroundings = {"LD_PRELOAD": str(shim), "WRITES_BELOW": str(run_dir), "WRITES_LOG": f"{run_dir}.log"}
        surroundings |= {f"WRITES_{name.upper()}": str(value) for name, value in told.items()}
        process = started(*run, f"run_dir={run_dir}", cwd=folder, one_thread=False, surroundings=surroundings)
        errors = errors_of(process)
        return process.returncode, errors

    reference = folder / "reference"
    status, errors = begun(reference)
    assert (status, errors) == (0, ""), errors
    seen = Path(f"{reference}.log").read_text().splitlines()
    chosen = _chosen([_kind_of_write(line) for line in seen], options["writes"])
    which, of = map(int, options["portion"].split("/"))
    print(f"writes: {len(seen)} of an undisturbed run, {len(chosen)} of them tried", flush=True)
    for number, (what, error) in list(chosen.items())[len(chosen) * (which - 1) // of : len(chosen) * which // of]:
        run_dir = folder / "disturbed"
        status, errors = begun(run_dir, fail=number, error=error)
        if status == 0:
            others = [line for line in errors.splitlines() if not line.startswith("vecpsmbpo: warning: ")]
            ended = same_end(run_dir, reference) if not others else f"status 0, and besides {' '.join(others)[-200:]!r}"
        else:
            ended = one_line(status, errors)
            if ended == ONE_LINE:
                status, errors = here([*run, f"run_dir={run_dir}"])
                ended = same_end(run_dir, reference) if status == 0 else f"not gone on with: {errors[-200:]!r}"
        shutil.rmtree(run_dir, ignore_errors=True)
        yield f"{what} fails with {errno.errorcode[error]}", ended


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


def _chosen(kinds: list[str], more: int) -> dict[int, tuple[str, int]]:
    """By number, from 1: what a write is called in the table, and the error that it fails with; they alternate."""
    found: dict[int, str] = {}
    numbers: dict[str, list[int]] = {}
    for number, kind in enumerate(kinds, start=1):
        numbers.setdefault(kind, []).append(number)
    for name in ("first", "middle", "last"):  # of all kinds: a part that is stopped has tried each
        for kind, own in numbers.items():
            number = own[{"first": 0, "middle": len(own) // 2, "last": -1}[name]]
            found.setdefault(number, f"{kind}, {name} of {len(own)}")
    rest = [number for number in range(1, len(kinds) + 1) if number not in found]
    for number in sorted(random.Random(0).sample(rest, min(more, len(rest)))):
        found[number] = f"{kinds[number - 1]}, write {number} of all"
    errors = (errno.ENOSPC, errno.EIO)
    return {number: (what, errors[index % 2]) for index, (number, what) in enumerate(found.items())}
