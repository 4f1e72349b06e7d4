"""Ctrl-C while there is nothing to save. Imports next to nothing, since it is there for the imports that follow."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType


@contextlib.contextmanager
def leaving(farewell: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Ctrl-C ends the process at once. As an exception it would be a traceback in the middle of an import, and could be
    lost in a module that is being imported, which catches everything.

    Only the main thread of a program may say what signals do; in another one this does nothing.

    Args:
        farewell: comes before the end.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        with contextlib.suppress(OSError):  # a terminal that is gone
            os.write(2, b"vecpsmbpo: interrupted\n")  # not by print, which may be what was interrupted
        farewell()
        os._exit(128 + number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
