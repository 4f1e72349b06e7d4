"""The signals that a run heeds. Imports no JAX: what only watches runs heeds them, too."""

import contextlib
import dataclasses
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from types import FrameType
from typing import Any, TextIO

Handler = Callable[[int, FrameType | None], Any]
UNHEARD = 128 + getattr(signal, "SIGPIPE", 13)  # the exit status of a program whose reader has gone
FINISHING = "finishing this chunk and saving; once more to stop at once"


@dataclasses.dataclass
class Stop:
    """What signals have asked for: `requested`, the one that asked to stop; `save`, to save and go on."""

    requested: int | None = None
    save: bool = False


@contextlib.contextmanager
def heeding_signals(words: str = FINISHING) -> Iterator[Stop]:
    """SIGINT, SIGTERM and SIGHUP ask to stop, by default a run after its chunk; a second one stops it at once. SIGHUP
    that is ignored, as `nohup` has it, stays so.

    Only the main thread of a program may say what signals do; in another one they stay what they are.

    Args:
        words: said at the first signal.
    """
    stop = Stop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    with _handling(dict.fromkeys(numbers, _asking(stop, words))):
        yield stop


@contextlib.contextmanager
def heeding_submitit(*, slurm: bool) -> Iterator[Stop]:
    """In a job of submitit's. SIGUSR2, which comes before its time is over or it is preempted, asks to stop.

    SIGTERM does, too, on this machine. Slurm sends it before it preempts or cancels a job, and then the run saves and
    goes on for as long as it is let: Slurm queues a preempted job again if it has not ended by itself, and a run cannot
    know whether it is being cancelled.
    """
    stop = Stop()

    def make_room(number: int, frame: FrameType | None) -> None:
        stop.requested = number  # Slurm may say it twice, for two reasons
        _say("finishing this chunk and saving, to go on later")

    def save(number: int, frame: FrameType | None) -> None:
        stop.save = True
        _say("saving after this chunk")

    with _handling({signal.SIGUSR2: make_room, signal.SIGTERM: save if slurm else _asking(stop, FINISHING)}):
        yield stop


def _asking(stop: Stop, words: str) -> Handler:
    """Asks to stop, and says so; the second time, stops at once."""

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.requested is not None:
            raise KeyboardInterrupt
        stop.requested = number
        _say(words)

    return ask


@contextlib.contextmanager
def _handling(handlers: Mapping[int, Handler]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _say(words: str) -> None:
    print(f"\n{words}", file=Outliving(sys.stderr), flush=True)


class Outliving:
    """A stream whose terminal or pipe may be gone, which must not take the run with it."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        with _unheard():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with _unheard():
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def _unheard() -> Iterator[None]:
    try:
        yield
    except OSError:
        speak_to_nobody()


def is_unheard() -> bool:
    """Whether nobody reads stdout any more, as of `| head`; nothing that is printed from now on is heard then."""
    with contextlib.suppress(AttributeError, OSError, ValueError):  # it is no file, or there is no such thing as `poll`
        poll = select.poll()
        poll.register(sys.stdout.fileno(), 0)  # what is wrong is told unasked
        if poll.poll(0):
            speak_to_nobody()
            return True
    return False


def speak_to_nobody() -> None:
    """Whatever is printed from now on is lost."""
    nobody = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nobody, stream)
    os.close(nobody)
