"""Tries what can befall a run, and counts: the same end as undisturbed, one line that says what is wrong, or a fault.

    tools/faults                               all parts, and 50 kills of each driver: hours
    tools/faults part=careless,files           some
    tools/faults part=kills kills=20           fewer kills
    tools/faults part=writes portion=2/4       the second quarter of what a part tries, where there are only minutes

results/faults.csv has a row for each trial: the same end as undisturbed, the same state with log lines that are lost
and said to be, one line that says what is wrong, or the fault; and the code that it was tried on, with + where that was
no commit's. A trial replaces its own row, and the rows of trials that its part no longer has go. The exit status is 0
if all were tried (what the machine lacks for a part, root or gcc, is said, and its rows stay) and there was no fault.
Parts:
    careless    commands and tasks with a mistake: one line, exit status 2, nothing created
    simulators  tasks that raise, give another shape or leave the program in the middle of a run; then mended, and gone
                on with
    files       each file of a run directory, and of a checkpoint of either driver, truncated, emptied, replaced by
                noise, one bit flipped; then gone on with. And directories that are not as the run left them: one line,
                nothing changed, and gone on with when they are
    signals     SIGINT, SIGTERM, SIGHUP, and kill -9 ten seconds later; then gone on with. SIGINT while modules are
                imported
    twice       a second process in the directory of a run
    writes      each kind of write (opening, writing, syncing, renaming, making a directory) to each kind of file of a
                run directory failing once, of a full disk or an I/O error: the first, the middle and the last one, and
                writes=20 drawn from all; each kind of a full disk at least; then gone on with. Of a run by the host's
                driver: both write by the same code. Needs gcc
    disk        disks of many sizes and numbers of files, which fill up in one write or another; then made larger, and
                gone on with. A folder that cannot be written. Mounts them, so needs root
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

from tools import provenance
from tools.harm.careless import careless
from tools.harm.ends import kills, signals, twice
from tools.harm.files import files
from tools.harm.runs import FINE, NotTried
from tools.harm.scarce import disk, limits
from tools.harm.simulators import simulators
from tools.harm.writes import writes
from vecpsmbpo import arguments
from vecpsmbpo.settings import SettingError

OUT = Path("results/faults.csv")
PARTS = {part.__name__: part for part in (careless, simulators, files, signals, twice, writes, disk, kills, limits)}


def _portion(text: str) -> str:
    which, of = map(int, text.split("/"))
    if not 1 <= which <= of:
        raise ValueError
    return text


OPTIONS = {
    "part": arguments.names("which to try", *PARTS, allowed=f"of {', '.join(PARTS)}, separated by commas"),
    "kills": arguments.whole("of each driver", 50, at_least=1),
    "writes": arguments.whole("drawn from all, besides each kind's first, middle and last", 20),
    "portion": arguments.Option("of what each part tries", "1/1", _portion, "which/of, such as 2/4"),
}


def main(words: Sequence[str]) -> int:
    alone, options = arguments.parse("faults", words, OPTIONS)
    for name in (*alone, *(set(options["part"]) - set(PARTS))):
        raise SettingError(f"{name}: no such part; part={','.join(PARTS)}")
    which, of = map(int, options["portion"].split("/"))
    tried_on, all_fine = provenance.code(), True
    for name in options["part"]:
        with tempfile.TemporaryDirectory() as folder:
            try:
                trials = list(PARTS[name](Path(folder).resolve(), options))
            except NotTried as why:
                print(f"{name}: not tried: {why}", flush=True)
                all_fine = False
                continue
            chosen = trials[len(trials) * (which - 1) // of : len(trials) * which // of]
            faults = 0
            for what, attempt in chosen:
                ended = attempt()
                faults += ended not in FINE
                print(f"{name}: {what}: {ended}", flush=True)
                # At once: a part that is stopped has told what it found.
                keep(name, [what for what, _ in trials], {"what": what, "ended": ended, **tried_on})
        all_fine &= faults == 0
        print(f"{name}: {len(chosen)} tried, {faults} faults", flush=True)
    return int(not all_fine)


def keep(part: str, names: Sequence[str], row: dict[str, str]) -> None:
    """Puts a row into the table, among those of its part, which tries what `names` says and nothing else."""
    rows = {(row["part"], row["what"]): row for row in csv.DictReader(OUT.open())} if OUT.exists() else {}
    rows[part, row["what"]] = {"part": part, **row}
    order = {name: place for place, name in enumerate(names)}
    kept = [row for row in rows.values() if row["part"] in PARTS and (row["part"] != part or row["what"] in order)]
    kept.sort(key=lambda row: (list(PARTS).index(row["part"]), order[row["what"]] if row["part"] == part else 0))
    with OUT.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["part", "what", "ended", "commit", "versions"], lineterminator="\n")
        writer.writeheader()
        writer.writerows(kept)


if __name__ == "__main__":
    sys.exit(arguments.as_tool("faults", main, __doc__, OPTIONS))
