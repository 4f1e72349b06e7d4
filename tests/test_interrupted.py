"""Runs whose task fails, or that are told to stop in the middle of an evaluation: nothing trained is lost."""

import dataclasses
import os
import re
import shutil
import signal
import types
from pathlib import Path

import pytest

from tests.helpers import assert_same_run, files_of
from vecpsmbpo import cli, evaluate, jsonl, training
from vecpsmbpo.drivers.host import HostDriver
from vecpsmbpo.envs.host.batched import SimulatorError
from vecpsmbpo.envs.host.dm_control import DmControlSimulator
from vecpsmbpo.settings import SettingError
from vecpsmbpo.stopping import Stop
from vecpsmbpo.training.loop import _Session


def test_a_simulator_that_fails_costs_its_stride_and_no_more(short_run, tmp_path, monkeypatch, capsys):
    """One line, the state before the stride is saved, and the mended task goes on to the same end."""
    settings, step = dataclasses.replace(short_run, run_dir=str(tmp_path / "a b=c")), DmControlSimulator.step
    left = [66]  # steps, those of an evaluation included

    def breaks(self, action):
        left[0] -= 1
        if left[0] < 0:
            raise SystemExit(0)  # what would end the program as if all were well
        return step(self, action)

    monkeypatch.setattr(DmControlSimulator, "step", breaks)
    assert cli._run(settings) == (1, True)
    monkeypatch.undo()
    said = capsys.readouterr()
    saved = evaluate.restore(settings)[1].step
    assert 0 < saved < 66
    assert re.fullmatch(
        rf"vecpsmbpo: ball_in_cup failed at step \d+: SystemExit: 0 at .*; saved at step {saved}; to continue: .*\n",
        said.err,
    )
    assert said.err.rstrip().endswith(
        """to continue: vecpsmbpo train 'run_dir='"'"'""" + str(tmp_path) + """/a b=c'"'"''"""
    )
    assert "Traceback" not in said.out + said.err
    assert training.train(settings) == 0
    assert_same_run(Path(settings.run_dir), Path(short_run.run_dir))


@pytest.mark.parametrize("failing", [80, 120])
def test_a_simulator_that_fails_in_an_evaluation_costs_no_training(failing, short_run, tmp_path, monkeypatch, capsys):
    """Of all that was trained since the last checkpoint nothing is lost, and the evaluation is made up for, though the
    run that did so was killed before it saved anything."""
    settings = dataclasses.replace(short_run, run_dir=str(tmp_path / "run"), checkpoint_every=5)
    evaluated = HostDriver.evaluate

    def fails(driver, state, *args):
        if int(state.counters.env_steps) == failing:
            raise SimulatorError("out of coal")
        return evaluated(driver, state, *args)

    monkeypatch.setattr(HostDriver, "evaluate", fails)
    for _ in range(2):
        said = f"failed in the evaluation at step {failing}: out of coal; saved at step {failing}; to continue"
        with pytest.raises(training.TaskFailed, match=said):
            training.train(settings)
        assert jsonl.read(tmp_path / "run" / "metrics.jsonl")[-1]["env_steps"] == failing - 40
    monkeypatch.undo()
    if failing < settings.total_steps:
        monkeypatch.setattr(_Session, "_chunk", os.kill)  # which wants arguments: an end without a save
        with pytest.raises(TypeError):
            training.train(settings)
        monkeypatch.undo()
    assert training.train(settings) == 0
    assert capsys.readouterr().err == ""
    assert_same_run(Path(settings.run_dir), Path(short_run.run_dir))


@pytest.mark.parametrize("stopped_at", [40, 120])
def test_a_signal_in_an_evaluation_is_heeded(stopped_at, short_run, tmp_path, monkeypatch, capsys):
    """Nothing of what was trained is lost, and the evaluation is made up for; also the last one."""
    settings = dataclasses.replace(short_run, run_dir=str(tmp_path / "run"), checkpoint_every=5)
    evaluated, stop = HostDriver.evaluate, Stop()

    def signalled(driver, state, *args):
        if int(state.counters.env_steps) == stopped_at:
            stop.requested = signal.SIGTERM
        return evaluated(driver, state, *args)

    monkeypatch.setattr(HostDriver, "evaluate", signalled)
    assert training.train(settings, stop) == 128 + signal.SIGTERM
    assert "to continue: vecpsmbpo train" in capsys.readouterr().out
    assert evaluate.restore(settings)[1].step == stopped_at
    assert all(line["env_steps"] < stopped_at for line in jsonl.read(tmp_path / "run" / "metrics.jsonl"))
    monkeypatch.undo()
    assert training.train(settings) == 0
    _assert_done(settings, short_run, capsys)


def test_a_save_in_the_last_evaluation_is_made_whole_when_it_is_over(short_run, tmp_path, monkeypatch, capsys):
    """What Slurm's SIGTERM asks for: to save, and to go on."""
    settings = dataclasses.replace(short_run, run_dir=str(tmp_path / "run"))
    evaluated, stop = HostDriver.evaluate, Stop()

    def signalled(driver, state, *args):
        stop.save = int(state.counters.env_steps) == settings.total_steps
        return evaluated(driver, state, *args)

    monkeypatch.setattr(HostDriver, "evaluate", signalled)
    assert training.train(settings, stop) == 0
    _assert_done(settings, short_run, capsys)


def _assert_done(settings, reference, capsys):
    """It is what the undisturbed run is, and knows that it is complete."""
    assert_same_run(Path(settings.run_dir), Path(reference.run_dir))
    capsys.readouterr()
    before = {name: content for name, content in files_of(Path(settings.run_dir)).items() if "tensorboard" not in name}
    assert training.train(settings) == 0
    said = capsys.readouterr()
    assert "already complete at" in said.out
    assert said.err == ""
    assert files_of(Path(settings.run_dir)).items() >= before.items()


@pytest.mark.parametrize("begun", [False, True])
def test_a_simulator_that_fails_at_its_first_reset_leaves_all_as_it_was(
    begun, short_run, tmp_path, monkeypatch, capsys
):
    """Of a new run, and of one that is gone on with."""
    settings = dataclasses.replace(short_run, run_dir=str(tmp_path / "run"))
    if begun:
        shutil.copytree(short_run.run_dir, tmp_path / "run")
    before = files_of(tmp_path)

    def fails(*_):
        raise ValueError("no coal")

    monkeypatch.setattr(DmControlSimulator, "load" if begun else "reset", fails)
    line = r"^ball_in_cup failed before its first step: ValueError: no coal at \S+; nothing has been changed$"
    with pytest.raises(training.TaskFailed, match=line):
        training.train(settings)
    assert capsys.readouterr().err == ""
    assert files_of(tmp_path) == before
    assert begun or not list(tmp_path.iterdir())


def test_a_task_that_cannot_be_made_again_has_failed_in_the_evaluation():
    def fails(**_):
        raise SettingError("env=mine: cannot be made")

    with pytest.raises(SimulatorError, match="env=mine: cannot be made"):
        HostDriver._others(types.SimpleNamespace(_make_env=fails), 1, 0)
