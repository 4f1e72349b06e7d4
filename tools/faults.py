"""Tries what can befall a run, and counts: the same end as undisturbed, one line that says what is wrong, or a fault.

    tools/faults                               all parts, and 100 kills of each driver; hours
    tools/faults part=careless,files           some
    tools/faults part=kills kills=20           fewer kills

Each part replaces its own rows of results/faults.csv, which say how it ended: the same end as undisturbed, the same
state with log lines that are lost and said to be, one line that says what is wrong, or the fault. Parts:
    careless    commands and tasks with a mistake: one line, exit status 2, nothing created
    files       each file of a run directory truncated, emptied, replaced by noise, one bit flipped; then gone on with
    signals     SIGINT, SIGTERM, SIGHUP, and kill -9 ten seconds later; then gone on with
    twice       a second process in the directory of a run
    writes      each kind of write (opening, writing, syncing, renaming, making a directory) to each kind of file of a
                run directory failing once, of a full disk or an I/O error: the first, the middle and the last one, and
                writes=20 drawn from all others; then gone on with. Needs gcc. portion=2/4 tries the second quarter of
                these, and keeps the rows of the others
    disk        disks of many sizes and numbers of files, which fill up in one write or another; then made larger, and
                gone on with (mounts them, so needs root)
    kills       kill -9 at random moments, one of five while a checkpoint is written, until the run is complete
    limits      of address space, from the start, while compiling and while training, and of open files; then gone on
                with as without (where not even the libraries have memory left, they may say so beside the one line)
"""

import contextlib
import csv
import errno
import io
import json
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.helpers import argv, environment
from tools.careless import COMMANDS, MODULES
from vecpsmbpo import arguments, checkpoint, cli, jsonl
from vecpsmbpo.settings import SettingError

OUT = Path("results/faults.csv")
SHIM = Path(__file__).with_name("writes.c")
RUN = ["size=tiny", "env=ball_in_cup", "loggers=[]"]  # 40 steps an epoch, a checkpoint each
STOPPED, END = 120, 160
TO_LIVE_S = 10.0
ANSWER_S = 100
# The last words of C++, LLVM, XLA, and of a Python that has no memory for others.
NATIVE = re.compile(
    r"terminate called|  what\(\):  |LLVM ERROR: |[EF]\d{4} [\d:.]+ +\d+ \w+\.cc:\d+\] "
    r"|Exception ignored in sys\.unraisablehook|MemoryError$"
)
MEMORIES_MB = (200, 600, 1000, 1800, 2600, 3400, 4200, 5000)
MORE_MB = (0, 1, 4, 16, 64, 128, 256)  # than it holds
OPEN_FILES = (8, 16, 24, 32, 48, 64, 96, 128, 256)
DISKS_KB = (64, 400, 800, 1100, 1200, 1300, 1400, 1600, 1800, 2000, 2200, 2400, 2600)
DISKS_FILES = (3, 20, 40, 60, 80, 100, 120, 140, 160, 200)
Found = tuple[str, str]  # what was tried, and how it ended: FINE or what was wrong
SAME, SAID, ONE_LINE = "same end", "same state, lost lines are said", "one line"
FINE = (SAME, SAID, ONE_LINE)


# ── what a run has come to ───────────────────────────────────────────────────────────────────────────────────────


def lines(run_dir: Path) -> list[dict]:
    """Of both logs, without what depends on the clock."""
    clock = {"env_steps_per_s", "updates_per_s", "imagined_per_s", "seconds", "compile_seconds"}
    files = (jsonl.METRICS_FILE, jsonl.EPISODES_FILE)
    return [{k: v for k, v in line.items() if k not in clock} for name in files for line in jsonl.read(run_dir / name)]


def arrays(run_dir: Path) -> int | None:
    """A checksum of the whole state at the end; None where it has not come to its end."""
    metadata = run_dir / f"checkpoints/{END}/host/metadata"
    return json.loads(metadata.read_text())["arrays"] if metadata.exists() else None


def same_end(run_dir: Path, undisturbed: Path) -> str:
    state = arrays(run_dir)
    if state is None:
        return "not gone on with"
    if state != arrays(undisturbed):
        return "another end"
    return SAME if lines(run_dir) == lines(undisturbed) else "other logs"


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def one_line(status: int, errors: str, expected: int | None = 2) -> str:
    """`expected`: the exit status; None is any but 0: how a process ends that gets no memory, the system says."""
    if expected is None:
        expected = status or 1
    told = [line for line in errors.splitlines() if line.startswith("vecpsmbpo: ") and "warning" not in line]
    others = [line for line in errors.splitlines() if not line.startswith("vecpsmbpo: ") and not NATIVE.match(line)]
    if (status, len(told), others) == (expected, 1, []):
        return ONE_LINE
    return f"status {status}, {len(told)} line(s), and besides {' '.join(others)[-200:]!r}"


def here(arguments: list[str]) -> tuple[int, str]:
    """A command in this process, which has compiled the program already: its exit status and what it said."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            status = cli.main(["train", *arguments])
        except BaseException as error:  # the fault that is looked for
            said.write(repr(error))
            status = -1
    return status, said.getvalue()


def command(*arguments: str, cwd: Path) -> subprocess.CompletedProcess:
    process = started(*arguments, cwd=cwd)
    said, errors = process.communicate()
    return subprocess.CompletedProcess(arguments, process.returncode, said, errors)


def started(
    *arguments: str,
    cwd: Path,
    limit: tuple[int, int] | None = None,
    one_thread: bool = True,
    surroundings: Mapping[str, str] = MappingProxyType({}),
) -> subprocess.Popen:
    """`limit`: a resource, and how much of it the process may have."""
    pipe, train = subprocess.PIPE, argv("train", *arguments, one_thread=one_thread)
    obey = partial(resource.setrlimit, limit[0], (limit[1],) * 2) if limit else None
    surrounded = {**environment(), **surroundings}
    return subprocess.Popen(train, cwd=cwd, env=surrounded, stdout=pipe, stderr=pipe, text=True, preexec_fn=obey)


def said_until(process: subprocess.Popen, word: str) -> None:
    """Waits until a process has begun a line with `word`, or ended."""
    assert process.stdout is not None
    next((line for line in process.stdout if line.startswith(word)), None)


def undisturbed(folder: Path, backend: str) -> Path:
    run_dir = folder / f"undisturbed_{backend}"
    result = command(*RUN, f"backend={backend}", f"total_steps={END}", f"run_dir={run_dir}", cwd=folder)
    assert result.returncode == 0, result.stderr
    return run_dir


# ── parts ────────────────────────────────────────────────────────────────────────────────────────────────────────


def careless(folder: Path, options: dict) -> Iterator[Found]:
    for name, code in MODULES.items():
        (folder / f"{name}.py").write_text(code)
    before = {path.name for path in folder.iterdir()}
    for words, surroundings in COMMANDS:
        surrounded = {**environment(), **surroundings, "PYTHONDONTWRITEBYTECODE": "1"}
        program = [sys.executable, "-m", "vecpsmbpo.cli", *words]
        try:
            result = subprocess.run(
                program, cwd=folder, env=surrounded, capture_output=True, text=True, timeout=ANSWER_S, check=False
            )
            ended = one_line(result.returncode, result.stderr)
        except subprocess.TimeoutExpired:
            ended = f"no answer within {ANSWER_S} s"
        for left in {path.name for path in folder.iterdir()} - before:
            ended = f"left {left}"
            shutil.rmtree(folder / left)
        set_as = "".join(f"{name}={value} " for name, value in surroundings.items())
        yield f"{set_as}{' '.join(words)}"[:80], ended


def files(folder: Path, options: dict) -> Iterator[Found]:
    run, whole = [*RUN, "backend=host"], folder / "stopped"
    assert here([*run, f"total_steps={STOPPED}", f"run_dir={whole}"])[0] == 0
    reference = folder / "reference"
    shutil.copytree(whole, reference)
    assert here([f"run_dir={reference}", f"total_steps={END}"])[0] == 0
    for which, damage in ((which, damage) for which in _kinds(whole) for damage in DAMAGES):
        damaged = folder / "damaged"
        shutil.rmtree(damaged, ignore_errors=True)
        shutil.copytree(whole, damaged)
        DAMAGES[damage](damaged / which)
        before = contents(damaged)
        status, said = here([f"run_dir={damaged}", f"total_steps={END}"])
        if status == 0:
            ended = same_end(damaged, reference)
            if ended == "other logs" and any(told in said for told in ("set aside", "are lost", "not as they were")):
                ended = SAID
        else:
            ended = one_line(status, said) if contents(damaged) == before else "it has been changed"
        yield f"{which} {damage}", ended


def _kinds(run_dir: Path) -> list[Path]:
    """One file of each kind in a run directory."""
    found: dict[str, Path] = {}
    newest = f"checkpoints/{STOPPED}"
    for path in sorted(run_dir.rglob("*"), key=lambda path: -path.stat().st_size):
        name = path.relative_to(run_dir)
        if path.is_file() and path.stat().st_size and (name.parts[0] != "checkpoints" or newest in str(name)):
            found.setdefault("array" if path.name[0].isdigit() else f"{name.parts[0]}/{path.name}", name)
    return list(found.values())


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1 << 2
    path.write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "emptied": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(random.Random(0).randbytes(path.stat().st_size)),
    "one bit flipped": _flip,
}


def signals(folder: Path, options: dict) -> Iterator[Found]:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a run inherits what nohup makes of it, and heeds that
    reference = undisturbed(folder, "host")
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        name = signal.Signals(number).name
        process = started(*RUN, "backend=host", f"total_steps={END}", f"run_dir={name}", cwd=folder)
        said_until(process, "step")
        process.send_signal(number)
        try:
            said, errors = process.communicate(timeout=TO_LIVE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            said, errors = process.communicate()
        command(f"run_dir={name}", cwd=folder)
        ended = same_end(folder / name, reference)
        if process.returncode != 128 + number or "to continue: " not in said:
            ended = f"{ended}, but status {process.returncode}: {errors[-200:]!r}"
        yield f"{name}, killed {TO_LIVE_S:.0f} s later", ended


def twice(folder: Path, options: dict) -> Iterator[Found]:
    arguments = (*RUN, "backend=host", f"total_steps={END}", "run_dir=run")
    first = started(*arguments, cwd=folder)
    said_until(first, "compiling")
    first.send_signal(signal.SIGSTOP)
    second = command(*arguments, cwd=folder)
    first.send_signal(signal.SIGCONT)
    first.communicate()
    yield "the second process", one_line(second.returncode, second.stderr)
    yield "the first process", same_end(folder / "run", undisturbed(folder, "host"))


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
        try:
            errors = process.communicate(timeout=ANSWER_S)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            errors = process.communicate()[1] + "has not ended"
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


def kills(folder: Path, options: dict) -> Iterator[Found]:
    dice = random.Random(0)
    for backend in ("host", "mjx"):
        began = time.perf_counter()
        reference = undisturbed(folder, backend)
        longest, done, runs = time.perf_counter() - began, 0, 0
        while done < options["kills"]:
            runs += 1
            run_dir, before, saving = folder / f"{backend}{runs}", done, 0
            while True:
                process = started(*RUN, f"backend={backend}", f"total_steps={END}", f"run_dir={run_dir}", cwd=folder)
                if done == options["kills"]:
                    process.communicate()
                    break
                if done % 5 == 0 and in_a_save(process, run_dir):
                    saving += 1
                else:
                    try:
                        process.communicate(timeout=dice.uniform(0, longest))
                        break
                    except subprocess.TimeoutExpired:
                        pass
                process.kill()
                process.communicate()
                done += 1
            what = f"{backend}: {done - before} kills of run {runs}, {saving} of them in a save"
            yield what, same_end(run_dir, reference)


def in_a_save(process: subprocess.Popen, run_dir: Path) -> bool:
    """Waits until a checkpoint is being written beside its place; False where the process ends before."""
    while process.poll() is None:
        if any(run_dir.glob(f"{checkpoint.FOLDER}/*orbax-checkpoint-tmp*")):
            return True
        time.sleep(0.001)
    return False


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
        try:
            errors = process.communicate(timeout=ANSWER_S)[1]
        except subprocess.TimeoutExpired:
            process.kill()
            errors = process.communicate()[1] + "has not ended"
        ended = SAME if process.returncode == 0 else one_line(process.returncode, errors, expected=None)
        if ended in FINE:
            command(*arguments, cwd=folder)
            ended = same_end(folder / f"limits{number}", reference)
        yield what, ended


PARTS = {part.__name__: part for part in (careless, files, signals, twice, writes, disk, kills, limits)}


def _portion(text: str) -> str:
    which, of = map(int, text.split("/"))
    if not 1 <= which <= of:
        raise ValueError
    return text


OPTIONS = {
    "part": arguments.names("which to try", *PARTS, allowed=f"of {', '.join(PARTS)}, separated by commas"),
    "kills": arguments.whole("of each driver", 100, at_least=1),
    "writes": arguments.whole("drawn from those that are no kind's first, middle or last", 20),
    "portion": arguments.Option("of the writes that are tried", "1/1", _portion, "which/of, such as 2/4"),
}


def main(words: Sequence[str]) -> int:
    alone, options = arguments.parse("faults", words, OPTIONS)
    for name in (*alone, *(set(options["part"]) - set(PARTS))):
        raise SettingError(f"{name}: no such part; part={','.join(PARTS)}")
    bad = 0
    for name in options["part"]:
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            for what, ended in PARTS[name](Path(folder).resolve(), options):
                print(f"{name}: {what}: {ended}", flush=True)
                rows.append({"part": name, "what": what, "ended": ended})
                keep(
                    name, rows, among=name == "writes" and options["portion"] != "1/1"
                )  # at once: a part that is stopped has told what it found
        bad += sum(row["ended"] not in FINE for row in rows)
        print(f"{name}: {len(rows)} tried, {sum(row['ended'] not in FINE for row in rows)} faults", flush=True)
    return int(bad > 0)


def keep(part: str, rows: list[dict], among: bool) -> None:
    """Puts the rows in the place of those that the table had of this part; `among` them, of those of the same name."""
    others = list(csv.DictReader(OUT.open())) if OUT.exists() else []
    names = {row["what"] for row in rows}
    kept = [row for row in others if row["part"] != part or (among and row["what"] not in names)]
    rows = [row for row in kept if row["part"] in PARTS] + rows
    with OUT.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["part", "what", "ended"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda row: list(PARTS).index(row["part"])))


if __name__ == "__main__":
    sys.exit(arguments.as_tool("faults", main, __doc__, OPTIONS))
