"""What a person at a terminal sees while a command works: a line on stderr that leaves nothing behind."""

from collections.abc import Iterable, Iterator
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

T = TypeVar("T")


class Working:
    """A context in which it is said what is being done, how far it has come and since when; where no terminal watches,
    nothing."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._progress = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[done]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", done="")

    def __enter__(self) -> "Working":
        self._progress.start()
        return self

    def __exit__(self, *failed: object) -> None:
        self._progress.stop()

    def on(self, what: str) -> None:
        """Something has begun of which nobody knows how long it takes."""
        self._begin(what, None)

    def through(self, steps: Iterable[T], what: str) -> Iterator[T]:
        """The steps, each counted when it is done."""
        every = list(steps)
        self._begin(what, len(every))
        for index, step in enumerate(every, start=1):
            yield step
            self._progress.update(self._task, completed=index, done=f"{index:,}/{len(every):,}")

    def _begin(self, what: str, total: int | None) -> None:
        self._progress.remove_task(self._task)
        self._task = self._progress.add_task(what, total=total, done="")
