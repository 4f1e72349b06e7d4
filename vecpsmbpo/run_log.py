"""What a run writes down: metrics.jsonl and episodes.jsonl, each epoch and episode exactly once; loggers are told, too.

And sessions.jsonl: a line for each time that somebody began, or went on with, the run.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from vecpsmbpo import jsonl
from vecpsmbpo.jsonl import EPISODES_FILE, METRICS_FILE, SESSIONS_FILE, Line
from vecpsmbpo.loggers import Loggers
from vecpsmbpo.settings import Settings


class RunLog:
    """The log files of one run directory."""

    def __init__(
        self,
        run_dir: Path,
        env_steps: int,
        settings: Settings,
        warn: Callable[[str], None],
        marks: Mapping[str, Any] = MappingProxyType({}),
        *,
        unevaluated: bool = False,
    ):
        """Lines beyond `env_steps` belong to work that a kill undid and that will be done again: they are dropped.

        Args:
            warn: is told what goes wrong with a logger, and what was found wrong in a file.
            marks: what `marks` was at `env_steps`.
            unevaluated: whether the epoch that ended there had not been evaluated: its lines will be written again.
        """
        self._lane = tuple(settings.lanes[0])
        needed = (jsonl.STEP, *self._lane)
        self._files = {
            name: jsonl.Growing(run_dir / name, env_steps, needed, marks.get(name), warn, unfinished=unevaluated)
            for name in (METRICS_FILE, EPISODES_FILE)
        }
        written = max(file.written for file in self._files.values())
        self._sessions = jsonl.Growing(run_dir / SESSIONS_FILE, jsonl.LARGEST_STEP, (jsonl.STEP,), None, warn)
        self._loggers = Loggers(settings, run_dir, env_steps, written, warn)

    @property
    def marks(self) -> dict[str, list[int]]:
        """By name of the file, what its lines are known by: for a checkpoint."""
        return {name: list(file.mark) for name, file in self._files.items()}

    def session(self, line: Line) -> None:
        """Writes down that a session began, and what with."""
        self._sessions.append([line])

    def episodes(self, lines: Iterable[Line]) -> None:
        """Writes finished episodes."""
        lines = list(lines)
        self._files[EPISODES_FILE].append(lines)
        for line in lines:
            self._scalars(line, ("return", "length"), "episode")

    def metrics(self, lines: Iterable[Line]) -> None:
        """Writes an epoch."""
        lines = list(lines)
        self._files[METRICS_FILE].append(lines)
        for line in lines:
            self._scalars(line, set(line) - {"env_steps", "seed"}, "epoch")
        self._loggers.flush()

    def _scalars(self, line: Line, names: Iterable[str], group: str) -> None:
        which = "_".join(f"{name}{line[name]}" for name in self._lane)
        numbers = {name: line[name] for name in names if isinstance(line[name], int | float)}
        self._loggers.scalars({f"{group}/{name}/{which}": value for name, value in numbers.items()}, line["env_steps"])

    def close(self) -> None:
        self._loggers.close()


class NoLog:
    """Of a process that does not write: as `RunLog`."""

    marks: Mapping[str, Any] = MappingProxyType({})

    def session(self, line: Line) -> None: ...

    def episodes(self, lines: Iterable[Line]) -> None: ...

    def metrics(self, lines: Iterable[Line]) -> None: ...

    def close(self) -> None: ...
