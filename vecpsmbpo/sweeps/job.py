"""What a job does, wherever it is: one run."""

import dataclasses
import os
import traceback
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Protocol

from vecpsmbpo import limits, words
from vecpsmbpo.jsonl import METRICS_FILE
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.stopping import Stop


@dataclasses.dataclass(frozen=True)
class Run:
    """What is sent to where the job runs.

    Attributes:
        settings: resolved where the command was given.
        folder: where that was. It, and the run directory, must be the same for all machines.
    """

    settings: Settings
    folder: Path

    @property
    def metrics(self) -> Path:
        return self.folder / self.settings.run_dir / METRICS_FILE


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a job ended: the exit status that its run alone would have had, and a line where there is more to say."""

    status: int
    said: str = ""


class Jobs(Protocol):
    """The jobs of a grid, in a cluster.

    Attributes:
        at_signal: what is said to whoever tells this command to stop.
    """

    at_signal: str

    def look(self) -> list[Outcome | str]:
        """Of each how it ended, or, while it has not, what it is doing in a word."""

    def stop(self) -> None:
        """Asks all of them to save and end. Is not called again before `look` has been.

        Raises:
            Elsewhere: they are not this process's to end.
        """


ASKING = "asking the jobs to save and to end; once more to leave at once"


class Elsewhere(Exception):
    """Jobs that go on without whoever watches them; says how to end them."""


def train(run: Run, heeding: AbstractContextManager[Stop]) -> Outcome:
    """Trains to the end, or a signal. Nothing that goes wrong leaves as an exception: an outcome reaches whoever waits
    for it in one piece."""
    os.chdir(run.folder)
    with heeding as stop:
        try:
            limits.check_start()
            from vecpsmbpo.training import DiskError, OutOfMemory, TaskFailed
            from vecpsmbpo.training import train as train_here
        except SettingError as error:
            return _failed(2, str(error))
        except (ImportError, ValueError, RuntimeError) as error:
            line = words.of_environment(error)
            return _failed(2, line) if line else _failed(1, words.of(error))
        try:
            return Outcome(train_here(run.settings, stop))
        except TaskFailed as error:
            return _failed(1, str(error))
        except (SettingError, DiskError, OutOfMemory) as error:
            return _failed(2, str(error))
        except Exception as error:
            traceback.print_exc()
            return _failed(1, words.of(error))


def _failed(status: int, said: str) -> Outcome:
    words.complain(said)
    return Outcome(status, said)
