"""Jobs as tasks of a Ray cluster, of one that is there or of one that lasts as long as the command."""

import signal
from collections.abc import Mapping, Sequence
from typing import Any

import ray

from vecpsmbpo import words
from vecpsmbpo.settings import SettingError
from vecpsmbpo.stopping import heeding_signals
from vecpsmbpo.sweeps.job import ASKING, Outcome, Run, train


class Preempted(Exception):
    """A job whose machine was taken away; Ray begins it again on another one."""


def _job(run: Run) -> Outcome:
    outcome = train(run, heeding_signals())
    if outcome.status == 128 + signal.SIGTERM:  # Ray's own way to stop a job is SIGINT
        raise Preempted
    return outcome


class Tasks:
    """A task for each run. What dies with its machine is begun again, and goes on from its checkpoint."""

    at_signal = ASKING

    def __init__(self, runs: Sequence[Run], options: Mapping[str, Any]):
        """
        Raises:
            SettingError: there is no such cluster, or Ray does not take the options.
        """
        try:
            ray.init(**options["init"], ignore_reinit_error=True)
            # A process for each: what a run leaves in JAX and on a GPU is not for the next one.
            remote = ray.remote(max_calls=1, retry_exceptions=[Preempted], **options["remote"])(_job)
            self._tasks = [remote.remote(run) for run in runs]
        except Exception as error:  # a cluster that does not start, or does not answer, raises just that
            said = str(error).strip().splitlines() or [type(error).__name__]
            raise SettingError(f"hydra/launcher=ray: {said[0]}") from None

    def look(self) -> list[Outcome | str]:
        ended, _ = ray.wait(self._tasks, num_returns=len(self._tasks), timeout=0)
        return [self._outcome(task) if task in ended else "" for task in self._tasks]

    def stop(self) -> None:
        for task in self._tasks:
            ray.cancel(task)

    @staticmethod
    def _outcome(task: Any) -> Outcome:
        try:
            return ray.get(task)
        except ray.exceptions.TaskCancelledError:
            return Outcome(128 + signal.SIGINT, "cancelled")
        except ray.exceptions.RayError as error:
            return Outcome(1, words.of(error))
