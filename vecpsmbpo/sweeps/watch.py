"""What a person sees of the jobs of a grid: how far each one is, and in the end a table."""

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from rich.console import Console
from rich.live import Live
from rich.table import Table

from vecpsmbpo import jsonl
from vecpsmbpo.stopping import heeding_signals
from vecpsmbpo.sweeps.job import Elsewhere, Jobs, Outcome, Run

LOOK_EVERY_S = 2.0
PLAIN_LINE_EVERY_S = 30.0  # of one job, where there is no terminal
PLAIN_WIDTH = 150
WORDS = {0: "done", 1: "failed, or a seed is frozen", 2: "refused"}


class Progress:
    """How far a run is, by its metrics.jsonl."""

    def __init__(self, path: Path):
        self._path, self._size = path, -1
        self.env_steps, self.eval_return = 0, float("nan")

    def look(self) -> bool:
        """Whether there is news. A file is read anew only when it has grown."""
        with contextlib.suppress(OSError):
            size = self._path.stat().st_size
            if size != self._size:
                self._size, before = size, self.env_steps
                lines = jsonl.read(self._path)
                self.env_steps = max((line[jsonl.STEP] for line in lines), default=0)
                last = [line.get("eval_return") for line in lines if line[jsonl.STEP] == self.env_steps]
                returns = [value for value in last if value is not None]
                self.eval_return = mean(returns) if returns else float("nan")
                return self.env_steps != before
        return False


def follow(jobs: Jobs, runs: Sequence[Run], console: Console | None = None) -> list[Outcome]:
    """Shows the jobs until all have ended, and how they did.

    Raises:
        Elsewhere: they go on, and whoever watched them is to stop watching.
        KeyboardInterrupt: a second signal; they have been asked a second time to stop, too.
    """
    view = _View(runs, console or Console(highlight=False, soft_wrap=True))
    with heeding_signals(jobs.at_signal) as stop:
        asked, seen = False, jobs.look()
        try:
            with view.live:
                while True:
                    view.show(seen)
                    outcomes = [outcome for outcome in seen if isinstance(outcome, Outcome)]
                    if len(outcomes) == len(seen):
                        break
                    if stop.requested is not None and not asked:
                        asked = True
                        jobs.stop()
                    time.sleep(LOOK_EVERY_S)
                    seen = jobs.look()
        except Elsewhere:
            view.end(seen)
            raise
        except KeyboardInterrupt:
            jobs.stop()
            raise
    view.end(outcomes)
    return outcomes


class _View:
    """The table of all jobs: in a terminal all the while, elsewhere at the end, after a line for each piece of news."""

    def __init__(self, runs: Sequence[Run], console: Console):
        self._runs, self._console = runs, console
        if not console.is_terminal:
            console.width = PLAIN_WIDTH
        self._progress = [Progress(run.metrics) for run in runs]
        self._said = [-PLAIN_LINE_EVERY_S] * len(runs)
        self._seen: list[Outcome | str] = [""] * len(runs)
        self.live: Live | contextlib.nullcontext = contextlib.nullcontext()
        if console.is_terminal:
            self.live = Live(console=console, auto_refresh=False, transient=True)

    def show(self, seen: Sequence[Outcome | str]) -> None:
        news = [progress.look() for progress in self._progress]
        if isinstance(self.live, Live):
            self.live.update(self._table(seen), refresh=True)
        else:
            for index, (job, before) in enumerate(zip(seen, self._seen, strict=True)):
                now = time.perf_counter()
                recent = now - self._said[index] < PLAIN_LINE_EVERY_S
                if (news[index] and not recent) or (isinstance(job, Outcome) and job != before):
                    self._said[index] = now
                    self._console.print(" ".join(["job", *self._row(index, job)]), markup=False)
        self._seen = list(seen)

    def end(self, seen: Sequence[Outcome | str]) -> None:
        self._console.print(self._table(seen))

    def _table(self, seen: Sequence[Outcome | str]) -> Table:
        table = Table("job", box=None)
        for name in ("run directory", "steps", "eval return", "status", ""):
            table.add_column(name, overflow="fold")
        for index, job in enumerate(seen):
            table.add_row(*self._row(index, job))
        return table

    def _row(self, index: int, job: Outcome | str) -> list[str]:
        settings, progress = self._runs[index].settings, self._progress[index]
        evaluated = "–" if progress.eval_return != progress.eval_return else f"{progress.eval_return:.4g}"
        status, words = (str(job.status), _words(job)) if isinstance(job, Outcome) else ("–", job)
        steps = f"{progress.env_steps}/{settings.total_steps}"
        return [str(index), settings.run_dir, steps, evaluated, status, words]


def _words(outcome: Outcome) -> str:
    return outcome.said or WORDS.get(outcome.status, f"stopped by signal {outcome.status - 128}")
