"""What a person sees of a run: a live line in a terminal, plain lines elsewhere."""

import sys
import time
from collections import deque
from types import TracebackType
from typing import NamedTuple, TextIO, cast

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from vecpsmbpo import stopping
from vecpsmbpo.algorithms.base import Algorithm

PLAIN_LINE_EVERY_S = 30.0  # where there is no terminal, besides the one at the end of each epoch


class Display:
    """Steps, returns, speeds and time left of one run."""

    def __init__(self, algorithm: Algorithm, env_steps: int, console: Console | None = None):
        settings = self._settings = algorithm.settings
        outliving = cast(TextIO, stopping.Outliving(sys.stdout))
        self._console = console or Console(file=outliving, highlight=False, soft_wrap=True)
        self._eval_return: float | None = None
        self._train_return: float | None = None
        self._pace = Pace(algorithm)
        self._live = self._console.is_terminal
        self._printed = -PLAIN_LINE_EVERY_S
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[news]}"),
            console=self._console,
            disable=not self._live,
        )
        self._task = self._progress.add_task(
            f"{settings.task} {settings.algo}", total=settings.total_steps, completed=env_steps, news=""
        )

    def __enter__(self) -> "Display":
        self._progress.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._progress.stop()

    def say(self, text: str) -> None:
        """One line that stays."""
        self._console.print(text, markup=False)

    def chunk(self, env_steps: int, steps: int, seconds: float, returns: list[float]) -> None:
        """A chunk of `steps` steps ended; `returns` are of the episodes that ended in it."""
        self._pace.chunk(env_steps, steps, seconds)
        if returns:
            self._train_return = sum(returns) / len(returns)
        line = self._line(env_steps)
        self._progress.update(self._task, completed=env_steps, news=line)
        if env_steps % self._settings.epoch_steps and time.perf_counter() - self._printed > PLAIN_LINE_EVERY_S:
            self._plain(env_steps, line)

    def epoch(self, env_steps: int, eval_return: float) -> None:
        """An epoch ended and was evaluated; mean over seeds."""
        self._eval_return = eval_return
        line = self._line(env_steps)
        self._progress.update(self._task, completed=env_steps, news=line)
        self._plain(env_steps, line)

    def _plain(self, env_steps: int, line: str) -> None:
        if not self._live:
            self.say(f"step {env_steps:>7} / {self._settings.total_steps}  {line}")
            self._printed = time.perf_counter()

    def _line(self, env_steps: int) -> str:
        def number(value: float | None) -> str:
            return "–" if value is None else f"{value:.4g}"

        rates = self._pace.rates
        return (
            f"return {number(self._train_return)}  eval {number(self._eval_return)}  "
            f"{rates.env_steps:.3g} steps/s  {rates.updates:.3g} updates/s  {rates.imagined:.3g} imagined/s  "
            f"left {self._pace.left(env_steps)}"
        )


class Rates(NamedTuple):
    """Speeds over some steps, of all seeds and members together, per second."""

    env_steps: float
    updates: float
    imagined: float

    @classmethod
    def over(cls, algorithm: Algorithm, env_steps: int, steps: int, seconds: float) -> "Rates":
        """Of the `steps` steps that ended at `env_steps` and took `seconds`."""
        settings = algorithm.settings
        learning = np.arange(max(env_steps - steps, settings.first_learning_step), env_steps)
        work = algorithm.work(learning, learning[learning % settings.model_update_every == 0])
        return cls(*(len(settings.lanes) * count / seconds for count in (steps, *work)))


class Pace:
    """Speeds over the last refresh period, or longer chunk, and what they say of the time left."""

    def __init__(self, algorithm: Algorithm):
        self._algorithm, self._settings = algorithm, algorithm.settings
        self._chunks: deque[tuple[int, float]] = deque()  # steps and seconds of each, all of one kind
        self._learning = False
        self.rates = Rates(0.0, 0.0, 0.0)

    def chunk(self, env_steps: int, steps: int, seconds: float) -> None:
        learning = env_steps > self._settings.first_learning_step
        if learning != self._learning:
            self._chunks.clear()
        self._learning = learning
        self._chunks.append((steps, seconds))
        # A whole period, since its refresh may take as long as the rest of it.
        while sum(steps for steps, _ in self._chunks) - self._chunks[0][0] >= self._settings.model_update_every:
            self._chunks.popleft()
        self.rates = Rates.over(self._algorithm, env_steps, *map(sum, zip(*self._chunks, strict=True)))

    def left(self, env_steps: int) -> str:
        """Time left; a dash before learning has begun, since warm-up steps say nothing of what follows."""
        if not self._learning:
            return "–"
        return duration((self._settings.total_steps - env_steps) / self.rates.env_steps * len(self._settings.lanes))


def duration(seconds: float) -> str:
    """1:02:03, or 2:03 below an hour."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02}:{second:02}" if hours else f"{minute}:{second:02}"


class Stopwatch:
    """Seconds since it was made, plus those of earlier sessions."""

    def __init__(self, before: float = 0.0):
        self._began = time.perf_counter() - before

    def __call__(self) -> float:
        return time.perf_counter() - self._began
