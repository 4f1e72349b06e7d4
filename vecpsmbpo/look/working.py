"""What a person at a terminal sees while a command works: a line on stderr that leaves nothing behind."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

T = TypeVar("T")

SOON = 2**22  # bytes that are read before anybody wonders


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


def steps(items: Iterable[T], what: str) -> Iterator[T]:
    """The items one by one, for work that has nothing else to say."""
    with Working() as working:
        yield from working.through(items, what)


@contextmanager
def reading(paths: Iterable[Path]) -> Iterator[Callable[[int], None]]:
    """A bar over the bytes of files, unless they are few; within it, a function to call with how many were read."""
    console = Console(stderr=True)
    total = sum(path.stat().st_size for path in paths if path.is_file())
    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    shown = console.is_terminal and total > SOON
    with Progress(*columns, console=console, transient=True, disable=not shown) as progress:
        task = progress.add_task("reading", total=total)
        yield lambda count: progress.advance(task, count)
