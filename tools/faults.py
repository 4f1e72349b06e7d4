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

import csv
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tools.harm.careless import careless
from tools.harm.ends import kills, signals, twice
from tools.harm.files import files
from tools.harm.runs import FINE
from tools.harm.scarce import disk, limits
from tools.harm.writes import writes
from vecpsmbpo import arguments
from vecpsmbpo.settings import SettingError

OUT = Path("results/faults.csv")
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
                # At once: a part that is stopped has told what it found.
                keep(name, rows, among=name == "writes" and options["portion"] != "1/1")
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
