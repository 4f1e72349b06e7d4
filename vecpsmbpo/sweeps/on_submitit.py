"""Jobs by submitit: Slurm's, or processes of this machine that are treated like them."""

import os
import signal
import subprocess
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import submitit
from submitit.slurm.slurm import SlurmInfoWatcher, SlurmJob

from vecpsmbpo import crash
from vecpsmbpo.settings import SettingError
from vecpsmbpo.stopping import heeding_submitit
from vecpsmbpo.sweeps.job import ASKING, Elsewhere, Outcome, Run, train

# Names that submitit has for every executor. What else `configs/hydra/launcher/submitit_slurm.yaml` lists is Slurm's.
GENERIC = ("name", "timeout_min", "mem_gb", "cpus_per_task", "gpus_per_node", "stderr_to_stdout")
# States of Slurm's from which a job does not come back by itself; one that nobody knows any more has ended, too.
ENDED = ("boot_fail", "cancelled", "completed", "deadline", "failed", "node_fail", "out_of_memory", "timeout", "gone")
ASK_AGAIN_S = 60  # at most; what a job has to say itself is seen at once


class Job:
    """What submitit pickles, calls in the job, and queues again when it has to make room."""

    def __init__(self, run: Run, *, slurm: bool):
        self.run, self.slurm = run, slurm

    def __call__(self) -> Outcome:
        queue_again = signal.getsignal(signal.SIGUSR2)
        with crash.watched():
            outcome = train(self.run, heeding_submitit(slurm=self.slurm))
        if outcome.status == 128 + signal.SIGUSR2 and callable(queue_again):
            queue_again(signal.SIGUSR2, None)  # submitit's own; ends the process
        return outcome

    def checkpoint(self) -> submitit.helpers.DelayedSubmission:
        """The same again: it goes on from the checkpoint in the run's directory."""
        return submitit.helpers.DelayedSubmission(self)


class Slurm:
    """One array of jobs."""

    at_signal = "leaving the jobs to themselves"

    def __init__(self, runs: Sequence[Run], options: Mapping[str, Any]):
        """
        Raises:
            SettingError: there is no Slurm here, or it does not take the jobs.
        """
        given = {name: value for name, value in options.items() if value is not None}
        folder, timeouts = given.pop("submitit_folder"), given.pop("max_num_timeout")
        try:
            executor = submitit.AutoExecutor(folder, cluster="slurm", slurm_max_num_timeout=timeouts)
            executor.update_parameters(
                **{name if name in GENERIC else f"slurm_{name}": value for name, value in given.items()}
            )
            SlurmJob.watcher = Queue(delay_s=ASK_AGAIN_S)  # whom all jobs ask
            self._jobs = executor.submit_array([Job(run, slurm=True) for run in runs])
        except (RuntimeError, ValueError, TypeError, NameError) as error:
            said = str(error).strip().splitlines() or [type(error).__name__]
            raise SettingError(f"hydra/launcher=submitit_slurm: {said[-1].strip()}") from None

    def look(self) -> list[Outcome | str]:
        return [_look(job) for job in self._jobs]

    def stop(self) -> None:
        ids = sorted({job.job_id.partition("_")[0] for job in self._jobs})
        raise Elsewhere(f"the jobs go on without this command; scancel {' '.join(ids)} ends them")


class Queue(SlurmInfoWatcher):
    """What Slurm says of jobs: its accounting, or, where it keeps none, its queue. (submitit would print an error each
    time then, and wait for ever for a job that has died.)"""

    def is_done(self, job_id: str, mode: str = "standard") -> bool:
        return _word(self.get_state(job_id, mode=mode)) in ENDED

    def update(self) -> None:
        awaited = self._registered - self._finished
        numbers = ",".join(sorted({job.partition("_")[0] for job in awaited}))
        if awaited:
            told = _ask("sacct", "--format=JobID,State,NodeList", "--parsable2", f"--jobs={numbers}")
            self._info_dict.update(self.read_info(told.stdout) if told.returncode == 0 else _queued(awaited, numbers))
        self._last_status_check = time.time()
        self._finished |= {job for job in awaited if self.is_done(job, mode="cache")}


def _queued(jobs: Iterable[str], numbers: str) -> dict[str, dict[str, str]]:
    """The states of jobs in the queue, which forgets them some minutes after their end."""
    told = _ask("squeue", "--noheader", "--array", "--states=all", "--format=%i %T", f"--jobs={numbers}")
    if told.returncode and "Invalid job id" not in told.stderr:
        return {}  # nobody answers: nothing is known
    states = dict(line.split(maxsplit=1) for line in told.stdout.splitlines())
    return {job: {"State": states.get(job, "GONE")} for job in jobs}


def _ask(*words: str) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(words, capture_output=True, text=True, check=False)
    except OSError as error:
        return subprocess.CompletedProcess(words, 1, "", str(error))


class Local:
    """Processes of this machine, so many at a time."""

    at_signal = ASKING

    def __init__(self, runs: Sequence[Run], options: Mapping[str, Any]):
        """
        Raises:
            SettingError: submitit does not take the options.
        """
        self._waiting = [Job(run, slurm=False) for run in runs]
        self._jobs: list[submitit.Job] = []
        self._count, self._most = len(runs), options["array_parallelism"]
        self._executor = submitit.LocalExecutor(options["submitit_folder"], max_num_timeout=options["max_num_timeout"])
        names = ("timeout_min", "signal_delay_s", "gpus_per_node")
        try:
            self._executor.update_parameters(**{name: options[name] for name in names})
        except (RuntimeError, ValueError, TypeError) as error:
            raise SettingError(f"hydra/launcher=submitit_local: {error}") from None
        self._ended: dict[int, Outcome] = {}

    def look(self) -> list[Outcome | str]:
        for index, job in enumerate(self._jobs):
            if index not in self._ended and isinstance(seen := _look(job), Outcome):
                self._ended[index] = seen
        while self._waiting and len(self._jobs) - len(self._ended) < self._most:
            self._jobs.append(self._start(self._waiting.pop(0)))
        running = ["running"] * len(self._jobs) + ["waiting"] * len(self._waiting)
        never: list[Outcome | str] = [Outcome(128 + signal.SIGTERM, "not begun")] * (self._count - len(running))
        return [self._ended.get(index, word) for index, word in enumerate(running)] + never

    def _start(self, job: Job) -> submitit.Job:
        # Ctrl-C in a terminal reaches all processes; these are told to stop by `stop`.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        try:
            return self._executor.submit(job)
        finally:
            signal.signal(signal.SIGINT, before)

    def stop(self) -> None:
        self._waiting.clear()
        for index, job in enumerate(self._jobs):
            if index not in self._ended:
                os.kill(int(job.job_id), signal.SIGTERM)  # of the process that looks after the job, and passes it on


def _look(job: submitit.Job) -> Outcome | str:
    if not job.done():
        return _word(job.state)
    try:
        return job.result()
    except submitit.core.utils.UncompletedJobError:  # killed, or crashed: it left its log, and no more
        lines = (job.stderr() or "").strip().splitlines()
        said = next((line for line in reversed(lines) if line.startswith("vecpsmbpo: ")), "vecpsmbpo: died")
        state = str(job.state).lower()
        return Outcome(1, f"{said.removeprefix('vecpsmbpo: ')} ({state}); its log is {job.paths.stderr}")


def _word(state: str) -> str:
    """`CANCELLED by 0`: cancelled."""
    return str(state).partition(" ")[0].lower()
