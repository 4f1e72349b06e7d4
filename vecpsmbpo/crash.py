"""Says a word where native code (XLA's compiler, a simulator) ends the process without one.

Nothing in a process can be relied upon once it has crashed. So a forked child, which does nothing but wait, holds the
other end of a pipe: through it come what the process is about to do, Python's stack if there is a crash, and that the
end is as it should be. The exit status stays the process's own.
"""

import contextlib
import faulthandler
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

ADVICE = "try devices=1, compile_cache=false, or another Python (which brings another jax)"
BESIDE_OTHERS = " beside other processes"
ADVICE_TO_SEVERAL = "another process of the run may have gone; to go on, give the same command again, in all of them"
REPORT = "crash.txt"  # in the run directory: Python's stack
_FATAL, _REPORT, _END = "Fatal Python error: ", "report: ", "the end"
# The last two are Slurm's, which sends them to all processes of a job.
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR2", "SIGCONT")
_NOT_FOR_THE_WATCHER = {getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)}
_pipe: int | None = None


@contextlib.contextmanager
def watched() -> Iterator[None]:
    """Watches this process as long as the context lasts. Costs a fork, of a process that has not imported JAX yet.

    Does nothing where JAX is there already (it has threads, which a fork must not copy: a program that imports this
    package looks after itself), or where there is no fork: then Python's stack is all that a crash leaves.
    """
    global _pipe
    if "jax" in sys.modules:
        yield
        return
    if not hasattr(os, "fork"):
        faulthandler.enable()
        yield
        return
    reading, writing = os.pipe()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _NOT_FOR_THE_WATCHER)
    watcher = os.fork()
    if watcher == 0:
        try:
            os.close(writing)
            _watch(reading)
        finally:
            os._exit(0)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    os.close(reading)
    _pipe = writing
    doing("starting")
    faulthandler.enable(writing, all_threads=False)
    try:
        yield
    finally:
        end()
        with contextlib.suppress(ChildProcessError):  # it ended before, and where SIGCHLD is ignored leaves no trace
            os.waitpid(watcher, 0)


def doing(what: str, run_dir: Path | None = None) -> None:
    """What a crash from now on would interrupt; and the run directory, once it is there."""
    _tell(what)
    if run_dir is not None:
        _tell(f"{_REPORT}{run_dir.absolute() / REPORT}")


def end() -> None:
    """From now on the process may end without a word. Not needed at the end of `watched`, but before `os._exit`."""
    global _pipe
    if _pipe is not None:
        _tell(_END)
        faulthandler.disable()
        os.close(_pipe)
        _pipe = None


def _tell(line: str) -> None:
    if _pipe is not None:
        with contextlib.suppress(OSError):  # somebody ended the watcher: no reason to end the run
            os.write(_pipe, f"{line}\n".encode())


def _watch(pipe: int) -> None:
    """The whole life of the child."""
    with contextlib.suppress(OSError):
        os.close(1)  # who reads the process's output need not wait for this one
    with open(pipe, errors="replace") as file:
        story = file.read()  # until the process is gone
    if text := obituary(story):
        # C++ tells what it aborts for, and may not have come to the end of its line: ours begins a new one.
        torn = f"{_FATAL}Aborted" in story
        print(f"\n{text}" if torn else text, file=sys.stderr, flush=True)


def obituary(story: str) -> str | None:
    """The one line about an end that was not announced; None about one that was. Writes the stack where it was told to.

    Args:
        story: all that came through the pipe.
    """
    from vecpsmbpo import versions  # which every start would wait for otherwise

    told, fatal, stack = story.partition(_FATAL)
    lines = told.splitlines()
    if not lines or lines[-1] == _END:
        return None
    doing = next(line for line in reversed(lines) if not line.startswith(_REPORT))
    how = f"crashed ({stack.splitlines()[0]})" if fatal else "was killed, or crashed without a trace,"
    advice = ADVICE_TO_SEVERAL if doing.endswith(BESIDE_OTHERS) else ADVICE
    text = f"vecpsmbpo: {how} while {doing}, with {versions.line()}; {advice}"
    report = next((line.removeprefix(_REPORT) for line in reversed(lines) if line.startswith(_REPORT)), None)
    if fatal and report:
        with contextlib.suppress(OSError):
            Path(report).write_text(f"{text}\n\n{fatal}{stack}")
            text += f"; Python's stack is in {report}"
    return text
