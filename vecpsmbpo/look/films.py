"""Films on a page: of a run's directory, or named by whoever asks for the page."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vecpsmbpo.look.runs import Run

if TYPE_CHECKING:
    from vecpsmbpo.look.page import Page

MAGIC = {".mp4": (4, b"ftyp"), ".gif": (0, b"GIF8")}  # where in a film, and what, says that it is one


def is_film(path: Path) -> bool:
    """Whether a file begins as its kind does."""
    at, magic = MAGIC[path.suffix.lower()]
    with path.open("rb") as file:
        return file.read(at + len(magic)).endswith(magic)


def of_run(run: Run) -> list[Path]:
    """Files in the run's directory that are called as films are."""
    return sorted(path for suffix in MAGIC for path in run.path.glob(f"*{suffix}"))


def add(page: "Page", paths: Sequence[Path]) -> None:
    """Those of the files that are films, each once."""
    from vecpsmbpo.look import page as html

    if paths := [path for path in dict.fromkeys(paths) if is_film(path)]:
        shown = [html.film(path.read_bytes(), path.suffix.lower(), path.stem) for path in paths]
        page.add("<h2>Videos</h2>", html.panels(shown))
