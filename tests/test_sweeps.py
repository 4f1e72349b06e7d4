"""Grids as jobs: what is shown of them, what status they end with, and that a preempted one goes on by itself."""

import importlib.util
import io
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest
from rich.console import Console

from tests.helpers import argv, check_log, command, environment, tiny
from vecpsmbpo import cli, config, jsonl
from vecpsmbpo.settings import SettingError
from vecpsmbpo.stopping import heeding_submitit
from vecpsmbpo.sweeps import launch, watch
from vecpsmbpo.sweeps.job import Elsewhere, Outcome, Run

SMALL = ["env=ball_in_cup", "backend=host", "size=tiny", "n_models=1", "n_policies=1", "loggers=[tensorboard]"]


class Fake:
    """Jobs that end one at a time, each time they are looked at."""

    at_signal = "asking them to end"

    def __init__(self, ends):
        self.ends, self.ended = ends, 0

    def look(self):
        self.ended += 1
        return [*self.ends[: self.ended], *["running"] * (len(self.ends) - self.ended)]

    def stop(self):
        self.ends = [*self.ends[: self.ended], *[Outcome(143)] * (len(self.ends) - self.ended)]


def runs(folder: Path, count: int) -> list[Run]:
    return [Run(tiny(run_dir=f"run{index}"), folder) for index in range(count)]


def test_every_job_is_in_the_table_with_its_progress_and_its_status(tmp_path, monkeypatch):
    monkeypatch.setattr(watch, "LOOK_EVERY_S", 0.0)
    (tmp_path / "run1").mkdir()
    lines = [{"env_steps": step, "seed": seed, "eval_return": step + seed} for step in (40, 80) for seed in (0, 1)]
    (tmp_path / "run1" / "metrics.jsonl").write_text("".join(map(jsonl.text_of, lines)))
    console = Console(record=True, file=io.StringIO())
    ends = [Outcome(0), Outcome(1, "ValueError: no"), Outcome(143)]
    assert watch.follow(Fake(ends), runs(tmp_path, 3), console) == ends
    rows = [line.split(maxsplit=5) for line in console.export_text().splitlines()[-3:]]
    assert [row[:5] for row in rows] == [
        ["0", "run0", "0/120", "–", "0"],
        ["1", "run1", "80/120", "80.5", "1"],  # the mean of both seeds
        ["2", "run2", "0/120", "–", "143"],
    ]
    assert [row[5].strip() for row in rows] == ["done", "ValueError: no", "stopped by signal 15"]


class Far(Fake):
    """Jobs that go on without the command; Ctrl-C comes while it looks at them."""

    at_signal = "leaving them"

    def look(self):
        if self.ended == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return super().look()

    def stop(self):
        raise Elsewhere("the jobs go on without this command; scancel 7 ends them")


def test_a_command_that_leaves_its_jobs_shows_how_far_they_are(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(watch, "LOOK_EVERY_S", 0.0)
    console = Console(record=True, file=io.StringIO())
    with pytest.raises(Elsewhere):
        watch.follow(Far([Outcome(0)] * 4), runs(tmp_path, 4), console)
    assert [line.split()[-1] for line in console.export_text().splitlines()[-4:]] == ["done"] * 2 + ["running"] * 2
    assert capfd.readouterr().err.split("\n") == ["", "leaving them", ""]


def program(path: Path, *lines: str) -> None:
    path.write_text("\n".join(["#!/bin/sh", *lines]) + "\n")
    path.chmod(0o755)


def test_a_slurm_without_accounting_is_asked_for_its_queue(tmp_path, monkeypatch, capfd):
    """submitit would never hear of a job that was killed, and print an error each time."""
    monkeypatch.setenv("SUBMITIT_LOG_LEVEL", "NOCONFIG")  # or it would close pytest's own handlers
    pytest.importorskip("submitit")
    from vecpsmbpo.sweeps.on_submitit import Queue

    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    jobs = ["7_0", "7_1", "7_2", "7_3"]

    def ended():
        queue = Queue()
        for job in jobs:
            queue.register_job(job)
        return [job for job in jobs if queue.is_done(job)]

    found = []
    for line in ("echo 7_0 RUNNING; echo 7_1 CANCELLED; echo 7_2 PENDING", "echo Invalid job id >&2; exit 1", "exit 1"):
        program(tmp_path / "sacct", "echo Slurm accounting storage is disabled >&2; exit 1")
        program(tmp_path / "squeue", line)
        found.append(ended())
    assert found == [["7_1", "7_3"], jobs, []]  # who does not answer says nothing
    program(tmp_path / "sacct", "echo 'JobID|State|NodeList'; echo '7_[0-2]|PENDING|a'; echo '7_3|CANCELLED by 0|a'")
    assert ended() == ["7_3"]
    assert capfd.readouterr() == ("", "")


def test_the_exit_status_is_the_worst_of_all(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(watch, "LOOK_EVERY_S", 0.0)
    monkeypatch.setitem(launch.LAUNCHERS, "fake", ("", "", __name__, "made"))
    settings = [run.settings for run in runs(tmp_path, 2)]

    def wrong():
        raise SettingError("seed=-1: must be a whole number")

    assert launch.launch("fake", {"ends": [Outcome(0), Outcome(0)]}, [lambda: settings[0], lambda: settings[1]]) == 0
    assert launch.launch("fake", {"ends": [Outcome(1), Outcome(0)]}, [lambda: settings[0], lambda: settings[1]]) == 1
    assert launch.launch("fake", {"ends": [Outcome(0)]}, [wrong, lambda: settings[1]]) == 2
    assert capsys.readouterr().err == "vecpsmbpo: seed=-1: must be a whole number\n"
    with pytest.raises(SettingError, match="run_dir=run0: 2 runs of the grid would write into it at once"):
        launch.launch("fake", {"ends": []}, [lambda: settings[0], lambda: settings[0]])


def made(runs, options):
    return Fake(options["ends"])


@pytest.mark.parametrize(
    ("launcher", "extra"), [("submitit_local", "slurm"), ("submitit_slurm", "slurm"), ("ray", "ray")]
)
def test_a_launcher_that_is_not_installed_is_one_line(launcher, extra, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["train", "-m", "seed=0,1", f"hydra/launcher={launcher}"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"vecpsmbpo: hydra/launcher={launcher}: needs the package ")
    assert error.endswith(f"; pip install 'vecpsmbpo[{extra}]'\n")
    assert error.count("\n") == 1


@pytest.mark.skipif(shutil.which("srun") is not None, reason="there is a Slurm here")
def test_no_slurm_here_is_one_line(tmp_path):
    pytest.importorskip("submitit")
    result = command("train", "-m", *SMALL, "seed=0,1", "hydra/launcher=submitit_slurm", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith('vecpsmbpo: hydra/launcher=submitit_slurm: Could not detect "srun"')
    assert result.stderr.count("\n") == 1


def test_what_slurm_says_before_it_takes_a_job_away():
    with heeding_submitit(slurm=True) as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert (stop.save, stop.requested) == (True, None)  # it would not be queued again if it ended
        os.kill(os.getpid(), signal.SIGUSR2)
        os.kill(os.getpid(), signal.SIGUSR2)
        assert stop.requested == signal.SIGUSR2


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="looks for the job's process in /proc")
@pytest.mark.parametrize(
    ("package", "launcher", "preempting"),
    [("submitit", "submitit_local", signal.SIGUSR2), ("ray", "ray", signal.SIGTERM)],
    ids=["submitit", "ray"],
)
def test_a_preempted_job_goes_on_by_itself(package, launcher, preempting, tmp_path):
    """Of two runs; the other one cannot be written, which the exit status says."""
    pytest.importorskip(package)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "refused").touch()
    words = [*SMALL, "total_steps=400", "run_dir=runs/preempted,runs/refused", f"hydra/launcher={launcher}"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    sweep = subprocess.Popen(argv("train", "-m", *words), cwd=tmp_path, env=environment(), **pipes)
    run_dir = tmp_path / "runs" / "preempted"
    while not jsonl.read(run_dir / "metrics.jsonl"):
        assert sweep.poll() is None, sweep.communicate()
        time.sleep(0.1)
    os.kill(holder(run_dir), preempting)
    out, err = sweep.communicate(timeout=600)
    assert sweep.returncode == 2, err
    first, second = jsonl.read(run_dir / jsonl.SESSIONS_FILE)
    assert first["env_steps"] == 0
    assert 40 <= second["env_steps"] < 400
    check_log(run_dir, config.load(run_dir))
    rows = {line.split()[1]: line.split() for line in out.splitlines()[-2:]}
    assert rows["runs/preempted"][2::2] == ["400/400", "0"]
    assert rows["runs/refused"][4] == "2"


def holder(run_dir: Path) -> int:
    """The process that trains in a directory: it has it open, as a lock."""
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if link.readlink() == run_dir:
                return int(link.parts[2])
        except OSError:  # not ours to look at, or gone
            continue
    raise AssertionError(f"nobody trains in {run_dir}")
