"""What somebody at a terminal sees while a command that looks at runs is at work; nothing is printed elsewhere."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, track

Item = TypeVar("Item")

SOON = 2**22  # bytes that are read before anybody wonders


def steps(items: Iterable[Item], what: str) -> Iterable[Item]:
    """The items one by one, with a bar of how many are done."""
    console = Console(stderr=True)
    return track(list(items), what, console=console, transient=True, disable=not console.is_terminal)


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
