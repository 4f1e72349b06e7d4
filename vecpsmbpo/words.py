"""What is said on stderr, one line each; exceptions, too, of other people's code, whose stack says less than where it
failed."""

import os
import re
import sys


def complain(what: object) -> None:
    """Says it on stderr. A value from a command line may hold line ends and what steers a terminal: they are shown."""
    text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in str(what))
    print(f"vecpsmbpo: {text}", file=sys.stderr, flush=True)


def warn(what: str) -> None:
    complain(f"warning: {what}")


def of(error: BaseException) -> str:
    """What an exception is, what it says, and the last line outside of this package that it came through."""
    said = _first_line(error)
    where, trace = "", error.__traceback__
    while trace is not None:
        frame = trace.tb_frame
        name, file = str(frame.f_globals.get("__name__")), frame.f_code.co_filename
        if name.partition(".")[0] not in ("vecpsmbpo", "importlib") and not file.startswith("<"):
            where = f" at {file}:{trace.tb_lineno}"
        trace = trace.tb_next
    return f"{type(error).__name__}{f': {said}' if said else ''}{where}"


def of_system(error: OSError) -> str:
    """Which file it was, if it was one, and what the operating system says of it."""
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"


def of_environment(error: BaseException) -> str | None:
    """Of an exception over an environment variable, which JAX and MuJoCo read when they are imported; None where it
    names none that is set."""
    said = str(error).upper().replace("JAX.", "JAX_")  # JAX names its own as jax_debug_nans or jax.debug_nans, too
    for name, value in os.environ.items():
        if name.startswith(("JAX_", "XLA_", "MUJOCO_", "PYOPENGL_")) and re.search(rf"\b{name}\b", said):
            return f"{name}={value}: {_first_line(error)}"
    return None


def _first_line(error: BaseException) -> str:
    try:
        said = str(error).strip()
    except Exception:  # other people's exceptions may fail at saying what they are
        said = ""
    return (said or " ").splitlines()[0].strip()[:200]
