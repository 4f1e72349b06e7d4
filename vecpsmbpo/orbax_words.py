"""What orbax says beside the errors that it raises, in tracebacks and from threads of its own: nothing."""

import logging
import sys
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any


class _OrbaxIsQuiet(logging.Filter):
    """Drops what orbax tells of every file that it cannot read or write, beside the error that it raises: through
    absl's logger and, where its tasks are given up, through asyncio's, which are also other people's."""

    def filter(self, record: logging.LogRecord) -> bool:
        frames = traceback.walk_tb(record.exc_info[2]) if record.exc_info else ()
        files = [record.pathname, *(frame.f_code.co_filename for frame, _ in frames)]
        return not any("orbax" in file or "tensorstore" in file for file in files)


def unless_given_up(hook: Callable[[Any], object], unraisable: Any) -> None:
    """Where one file cannot be read or written, orbax closes the loop that waits for the others, and each of them says
    so, some of them while the process ends."""
    if "Event loop is closed" not in str(unraisable.exc_value):
        hook(unraisable)


def silence() -> None:
    """From now on, in this process."""
    for name in ("absl", "asyncio"):
        logging.getLogger(name).addFilter(_OrbaxIsQuiet())
    logging.getLogger("orbax").setLevel(logging.CRITICAL)
    sys.unraisablehook = partial(unless_given_up, sys.unraisablehook)
