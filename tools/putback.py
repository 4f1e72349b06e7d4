"""Makes run directories of a committed table of curves again, so that `plot`, `compare` and `figure` can draw it.

    python tools/putback.py results/ball_in_cup_algorithms_curves.csv out=runs/fig5 env=ball_in_cup size=cpu num_seeds=5

The settings are those that the runs had, as on the command line of `train`; they must name as many seeds as the table
has. Of several runs in the table each becomes a directory in `out`, of its own settings where these are given after its
name (`runs/fig5` has one of PS-MBPO, and ten seeds of OPS-MBPO):

    python tools/putback.py ... env=ball_in_cup size=cpu num_seeds=5 ball: num_seeds=10 ball_ps_mbpo: algo=ps_mbpo

What a table does not have, its runs do not have either: there are no episodes, checkpoints and seconds to look at.
"""

import csv
import dataclasses
import itertools
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from vecpsmbpo import arguments, config
from vecpsmbpo.config import CONFIG_FILE
from vecpsmbpo.jsonl import EPISODES_FILE, METRICS_FILE
from vecpsmbpo.look import files
from vecpsmbpo.settings import SettingError, Settings

OPTIONS = {"out": arguments.out("where the run directories go", "runs/putback")}
Row = dict[str, str]


def main(words: Sequence[str]) -> int:
    """The tool; its exit status.

    Raises:
        SettingError: a mistake in `words` or in the table, or a directory that is not empty.
    """
    own = [word for word in words if word.partition("=")[0] in OPTIONS]
    _, options = arguments.parse("putback", own, OPTIONS)
    table, *rest = [word for word in words if word not in own] or [""]
    runs = _runs_of(Path(table))
    for name, settings in _settings_of(rest, list(runs)).items():
        folder = options["out"] / name
        _write(folder, dataclasses.replace(settings, run_dir=str(folder)), runs[name])
        print(f"written: {folder}")
    return 0


def _runs_of(table: Path) -> dict[str, list[Row]]:
    """The table's rows by the name of their run, by rising steps.

    Raises:
        SettingError: it is no table that `plot` writes.
    """
    try:
        with table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SettingError(f"{table}: no table that can be read ({error})") from None
    if not rows or not {"run", "swept", "env_steps", "seed"} <= rows[0].keys():
        raise SettingError(f"{table}: no table of curves, as plot out=FILE.csv writes it")
    rows.sort(key=lambda row: (row["run"], float(row["env_steps"])))
    return {name: list(rows) for name, rows in itertools.groupby(rows, lambda row: row["run"])}


def _settings_of(words: Sequence[str], names: Sequence[str]) -> dict[str, Settings]:
    """Of each run: the words before the first `name:`, and those after its own."""
    shared: list[str] = []
    own: dict[str, list[str]] = {name: [] for name in names}
    into = shared
    for word in words:
        if not word.endswith(":"):
            into.append(word)
        elif word[:-1] in own:
            into = own[word[:-1]]
        else:
            raise SettingError(f"{word} no such run in the table, which has {', '.join(names)}")
    return {name: config.compose([*shared, *more]) for name, more in own.items()}


def _write(folder: Path, settings: Settings, rows: Sequence[Row]) -> None:
    lines = [dict(_line(row)) for row in rows]
    names = settings.lanes[0].keys()
    if {tuple(map(line.get, names)) for line in lines} != {tuple(lane.values()) for lane in settings.lanes}:
        raise SettingError(f"{folder.name}: the table has other seeds or swept values than these settings")
    if (folder / CONFIG_FILE).exists():
        raise SettingError(f"out={folder.parent}: holds a run {folder.name}; nothing is written over it")
    text = "".join(json.dumps(line) + "\n" for line in lines)
    files.write_together(folder, {METRICS_FILE: text.encode(), EPISODES_FILE: b""})
    config.save(settings, folder)


def _line(row: Row) -> Iterator[tuple[str, Any]]:
    """A row as a line of metrics.jsonl has it."""
    for name, value in row.items():
        if name == "swept":
            yield from ((key, float(number)) for key, number in (word.split("=") for word in value.split()))
        elif name in ("env_steps", "seed"):
            yield name, int(value)
        elif name != "run":
            yield name, float(value) if value else None


if __name__ == "__main__":
    sys.exit(arguments.as_tool("putback", main, __doc__, OPTIONS))
