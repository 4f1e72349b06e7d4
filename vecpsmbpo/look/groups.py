"""Which lanes belong together, and what a group is called: by what differs between them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vecpsmbpo.algorithms import TABLE
from vecpsmbpo.algorithms.catalogue import FIELDS
from vecpsmbpo.config import closest
from vecpsmbpo.look.runs import Lane, Run
from vecpsmbpo.settings import CHANGEABLE, SettingError

# Of two runs that differ in these alone, one may stand for the other, or prolong it.
_UNTOLD = ({"seed", "num_seeds", "run_dir"} | CHANGEABLE) - {"eval_policy", "eval_actions"}
RUN = "run"  # group=run: by run directory

SYMBOLS = {
    "real_ratio": "λ",
    "temperature": "τ",
    "n_models": "N",
    "n_policies": "M",
    "updates_per_step": "G",
    "prior_scale": "β",
    "forced_exploration": "τ_f",
    "discount": "γ",
}


@dataclass(frozen=True)
class Group:
    """Lanes that differ in their seeds only.

    Attributes:
        values: of what tells the groups apart, by name.
        lanes: one for each seed.
    """

    values: dict[str, Any]
    lanes: list[Lane]

    @property
    def name(self) -> str:
        """`OPS-MBPO, λ = 0.3`."""
        return ", ".join(label(name, value) for name, value in self.values.items()) or display(
            "algo", self.lanes[0].run.settings.algo
        )


def display(name: str, value: Any) -> str:
    """A value as a person writes it."""
    if name == "algo":
        return TABLE[value].title if value in TABLE else str(value)
    if name == "real_ratio_schedule":
        return {"linear": "λ falling from 1", "bandit": "λ chosen online"}.get(value, f"λ {value}")
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return "∞" if math.isinf(value) else f"{value:g}" if abs(value) < 1e6 else f"{value:.3g}"
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def label(name: str, value: Any) -> str:
    """A setting with its value: `λ = 0.3`."""
    shown, symbol = display(name, value), SYMBOLS.get(name)
    if name in ("algo", "real_ratio_schedule", RUN):
        return shown
    return f"{symbol} {shown}" if symbol and isinstance(value, str) else f"{symbol or name} = {shown}"


def averaged(groups: Iterable[Group], average: str, band: str, columns: Sequence[str] = ("eval_return",)) -> str:
    """What the curves of groups are: `mean of 3 to 5 seeds, 95% bootstrap band`; one seed has no band."""
    seeds = {sum(lane.has_any(name) for lane in one.lanes) for one in groups for name in columns}
    if max(seeds) == 1:
        return "one seed"
    of = f"{min(seeds)} to {max(seeds)}" if len(seeds) > 1 else f"{max(seeds)}"
    return f"{average} {of} seeds, {band}"


def common_task(runs: Sequence[Run]) -> str:
    """The task of all runs.

    Raises:
        SettingError: they are of different tasks.
    """
    tasks = {run.settings.task: run.path for run in runs}
    if len(tasks) > 1:
        (one, here), (other, there) = list(tasks.items())[:2]
        raise SettingError(f"run_dir: must all be of one task; {here} is of {one}, {there} of {other}")
    return next(iter(tasks))


def group(runs: Sequence[Run], by: Sequence[str] = ()) -> list[Group]:
    """The lanes of all runs in groups, by the settings `by`, or without any by what differs between them.

    Of settings that differ, only as many are named as tell all groups apart: an algorithm brings settings of its own.
    Where the same seed would be in a group twice, run directories are told apart, too.

    Raises:
        SettingError: there is no such setting.
    """
    lanes = [lane for run in runs for lane in run.lanes]
    facts = [_facts(lane) for lane in lanes]
    for name in by:
        if name != RUN and not any(name in fact for fact in facts):
            raise SettingError(f"group={name}: no such setting; {closest(name, (*FIELDS, RUN))}")
    names = list(by) or _distinguishing(facts)
    if not by and _repeats(lanes, facts, names):
        names.append(RUN)
    groups: dict[tuple, Group] = {}
    for lane, fact in zip(lanes, facts, strict=True):
        values = {name: fact.get(name) for name in names}
        groups.setdefault(tuple(values.values()), Group(values, [])).lanes.append(lane)
    return sorted(groups.values(), key=_rank)


def _facts(lane: Lane) -> dict[str, Any]:
    """Every setting of a lane, with what its run swept, its task's options, and the run's directory."""
    settings = lane.run.settings
    plain = {name: getattr(settings, name, None) for name in FIELDS}
    if plain["real_ratio_schedule"] not in (None, "constant"):
        plain["real_ratio"] = {"bandit": "chosen online", "linear": "falling from 1"}[plain["real_ratio_schedule"]]
    options = {f"env.{name}": value for name, value in settings.env_options}
    return {**plain, **options, **lane.values, RUN: _shortest(lane.run.path)}


def _shortest(path: Path) -> str:
    return path.resolve().name


def _distinguishing(facts: Sequence[Mapping[str, Any]]) -> list[str]:
    """The fewest settings, in their order, `algo` first, that tell apart all that differ in any."""
    known = [name for name in facts[0] if name not in _UNTOLD and name != RUN and not _of_task(name)]
    names: list[str] = []
    # A task brings settings of its own, too: what counts is what differs within one.
    classes: list[tuple] = [tuple(value for name, value in fact.items() if _of_task(name)) for fact in facts]
    for name in sorted(known, key=lambda name: name != "algo"):
        finer = [(*before, fact.get(name)) for before, fact in zip(classes, facts, strict=True)]
        if len(set(finer)) > len(set(classes)):
            names.append(name)
            classes = finer
    return names


def _of_task(name: str) -> bool:
    return name == "env" or name.startswith("env.")


def _repeats(lanes: Sequence[Lane], facts: Sequence[Mapping[str, Any]], names: Sequence[str]) -> bool:
    seen = [
        (lane.run.settings.task, lane.values["seed"], *(fact.get(name) for name in names))
        for lane, fact in zip(lanes, facts, strict=True)
    ]
    return len(set(seen)) < len(seen)


def _rank(group: Group) -> tuple:
    """Algorithms in the order of their table, numbers by size, the rest by name."""
    order = list(TABLE)

    def key(name: str, value: Any) -> tuple[int, float, str]:
        if name == "algo":
            return 0, order.index(value) if value in order else len(order), ""
        if isinstance(value, int | float):
            return 0, float(value), ""
        return 1, 0.0, str(value)

    return tuple(key(name, value) for name, value in group.values.items())
