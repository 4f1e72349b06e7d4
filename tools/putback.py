"""Makes run directories of a committed table of curves again, so that `plot`, `compare` and `figure` can draw it.

    python tools/putback.py results/ball_in_cup_algorithms_curves.csv out=runs/fig5 env=ball_in_cup size=cpu num_seeds=5

The settings are those that the runs had, as on the command line of `train`; they must name as many seeds as the table
has. Of several runs in the table each becomes a directory in `out`, of its own settings where these are given after its
name (`runs/fig5` has one of PS-MBPO, and ten seeds of OPS-MBPO):

    python tools/putback.py ... env=ball_in_cup size=cpu num_seeds=5 ball: num_seeds=10 ball_ps_mbpo: algo=ps_mbpo

What a table does not have, its runs do not have either: there are no checkpoints to look at, and no episodes but those
that `episodes=FILE.csv` has of a single run, by its seed and swept values:

    python tools/putback.py results/real_ratio.csv episodes=results/real_ratio_episodes.csv ...
"""

import csv
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from vecpsmbpo import arguments, config, jsonl, metrics
from vecpsmbpo.jsonl import EPISODES_FILE, METRICS_FILE
from vecpsmbpo.look import files
from vecpsmbpo.settings import SettingError, Settings

OPTIONS = {
    "out": arguments.out("where the run directories go", "runs/putback"),
    "episodes": arguments.text("a table of the episodes, of a single run", allowed="a file"),
}


class Epoch(NamedTuple):
    """A row of the table.

    Attributes:
        lane: its seed and swept values, as `_name` gives them.
        numbers: the others, as metrics.jsonl has them.
    """

    lane: str
    numbers: jsonl.Line


def _name(lane: Mapping[str, Any]) -> str:
    """With six digits, as `plot` writes swept values."""
    return " ".join(f"{name}={float(value):g}" for name, value in lane.items())


def _lanes_of(settings: Settings) -> dict[str, dict[str, Any]]:
    """What each lane is marked with in the logs, by its name: the values as the settings have them, all digits."""
    return {_name(lane): metrics.lane_of(settings, index) for index, lane in enumerate(settings.lanes)}


def main(words: Sequence[str]) -> int:
    """The tool; its exit status.

    Raises:
        SettingError: a mistake in `words` or in the table, or a run that is there already. Nothing is written then.
    """
    own = [word for word in words if word.partition("=")[0] in OPTIONS]
    _, options = arguments.parse("putback", own, OPTIONS)
    table, *rest = [word for word in words if word not in own] or [""]
    if not table:
        raise SettingError("needs a table of curves, and the settings of its runs")
    runs = _runs_of(Path(table))
    settings = _settings_of(rest, list(runs))
    for name, epochs in runs.items():
        _check(options["out"], name, settings[name], epochs)
    episodes = _episodes_of(Path(options["episodes"]), list(settings.values())) if options["episodes"] else b""
    for name, epochs in runs.items():
        folder = options["out"] / name
        lanes = _lanes_of(settings[name])
        text = "".join(jsonl.text_of(lanes[epoch.lane] | epoch.numbers) for epoch in epochs)
        files.write_together(folder, {METRICS_FILE: text.encode(), EPISODES_FILE: episodes})
        config.save(dataclasses.replace(settings[name], run_dir=str(folder)), folder)
        print(f"written: {folder}")
    return 0


def _check(out: Path, name: str, settings: Settings, epochs: Sequence[Epoch]) -> None:
    """That a run of the table can be put back as one of these settings.

    Raises:
        SettingError: it cannot.
    """
    if {epoch.lane for epoch in epochs} != {_name(lane) for lane in settings.lanes}:
        raise SettingError(f"{name}: the table has other seeds or swept values than these settings")
    if len({(epoch.lane, epoch.numbers[jsonl.STEP]) for epoch in epochs}) < len(epochs):
        raise SettingError(f"{name}: the table has a step of a seed twice, as of two runs of this name")
    if (last := epochs[-1].numbers[jsonl.STEP]) > settings.total_steps:
        raise SettingError(f"{name}: total_steps={settings.total_steps}: the table goes to step {last}")
    if name != Path(name).name:
        raise SettingError(f"{name}: no name of a directory")
    if (out / name).exists():
        raise SettingError(f"out={out}: holds a {name}; nothing is written over it")


def _runs_of(table: Path) -> dict[str, list[Epoch]]:
    """The rows of each run that the table has, by its name; by rising steps.

    Raises:
        SettingError: it is no table that `plot` writes.
    """
    rows = _rows_of(table)
    if not rows or not {"run", "env_steps", "seed"} <= rows[0].keys():
        raise SettingError(f"{table}: no table of curves, as plot out=FILE.csv writes it")
    runs: dict[str, list[Epoch]] = {}
    try:
        for row in rows:
            if None in row.values():
                raise ValueError("it is too short")
            runs.setdefault(row.pop("run"), []).append(_epoch(**row))
    except (ValueError, TypeError) as error:
        raise SettingError(f"{table}: has a row that plot does not write ({error})") from None
    return {name: sorted(epochs, key=lambda epoch: epoch.numbers[jsonl.STEP]) for name, epochs in runs.items()}


def _rows_of(table: Path) -> list[dict[str, str]]:
    """By the names of the columns.

    Raises:
        SettingError: it is no table that can be read.
    """
    try:
        with table.open(newline="", encoding="utf-8") as file:
            return list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SettingError(f"{table}: no table that can be read ({error})") from None


def _epoch(env_steps: str, seed: str, swept: str = "", **numbers: str) -> Epoch:
    """`swept` is missing in tables that were written before there were sweeps."""
    values = {name: float(value) for name, value in (word.split("=") for word in swept.split())}
    others = {name: _number(text) for name, text in numbers.items()}
    return Epoch(_name({"seed": int(seed), **values}), {jsonl.STEP: int(env_steps), **others})


def _episodes_of(table: Path, settings: Sequence[Settings]) -> bytes:
    """episodes.jsonl of a table that has each episode's seed, swept values and numbers.

    Raises:
        SettingError: it cannot be read, or is not of the one run whose settings these are.
    """
    if len(settings) != 1:
        raise SettingError(f"episodes={table}: is of one run, and there are {len(settings)}")
    lanes = _lanes_of(settings[0])
    lines = []
    for row in _rows_of(table):
        try:
            lane = lanes[_name({name: row.pop(name) for name in settings[0].lanes[0]})]
            numbers = {name: _number(text) for name, text in row.items()}
            lines.append(jsonl.text_of(lane | numbers | {jsonl.STEP: int(row[jsonl.STEP])}))
        except (KeyError, ValueError, TypeError) as error:
            raise SettingError(f"{table}: has a row that is not of this run ({error})") from None
    return "".join(lines).encode()


def _number(text: str) -> float | list[float] | None:
    """What metrics.jsonl had: nothing, a number, or several, as `real_ratio_probs` has."""
    several = [float(number) for number in text.split()]
    return several if len(several) > 1 else several[0] if several else None


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


if __name__ == "__main__":
    sys.exit(arguments.as_tool("putback", main, __doc__, OPTIONS))
