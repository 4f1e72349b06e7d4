"""One run over several processes, on this machine: the same as in one process with as many devices, to the bit."""

import json
import shutil
import signal
import socket
import subprocess
import threading
import time

import jax
import numpy as np
import pytest

from tests.helpers import argv, environment, without_times
from vecpsmbpo import cli, jsonl, processes, training
from vecpsmbpo.drivers import host
from vecpsmbpo.envs.host.batched import SimulatorError
from vecpsmbpo.settings import SettingError

RUN = ("train", "size=tiny", "loggers=[]")


@pytest.fixture
def start(tmp_path):
    """Starts the processes of a run, with so many devices each; none outlives the test."""
    started = []

    def begin(count, *words, devices=1):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        where = {"cwd": tmp_path, "env": environment(devices), "text": True}
        running = [
            subprocess.Popen(
                argv(*RUN, *words, f"distributed=127.0.0.1:{port}/{index}/{count}"),
                **where,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
            )
            for index in range(count)
        ]
        started.extend(running)
        return running

    yield begin
    for process in started:
        process.kill()


def end(running):
    """Exit status, stdout and stderr of each."""
    said = [process.communicate(timeout=500) for process in running]
    return [(process.returncode, *texts) for process, texts in zip(running, said, strict=True)]


def alone(devices, cwd, *words):
    done = subprocess.run(
        argv(*RUN, *words), cwd=cwd, env=environment(devices), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def arrays(run_dir):
    """A checksum of the whole state at the end."""
    return json.loads((run_dir / "checkpoints/120/host/metadata").read_text())["arrays"]


def check_same_end(several, one):
    """State and logs, to the bit."""
    assert arrays(several) == arrays(one)
    for name in (jsonl.METRICS_FILE, jsonl.EPISODES_FILE):
        assert without_times(jsonl.read(several / name)) == without_times(jsonl.read(one / name))


def check_nearly_same_end(run_dir, other):
    """The state to the bit, and what is logged of it but for means over members, whose sums are in another order."""
    assert arrays(run_dir) == arrays(other)
    assert jsonl.read(run_dir / jsonl.EPISODES_FILE) == jsonl.read(other / jsonl.EPISODES_FILE)
    both = (without_times(jsonl.read(path / jsonl.METRICS_FILE)) for path in (run_dir, other))
    for line, others in zip(*both, strict=True):
        assert line.keys() == others.keys()
        numbers = [[np.nan if value is None else value for value in one.values()] for one in (line, others)]
        np.testing.assert_allclose(*numbers, rtol=1e-5)


@pytest.mark.parametrize(
    ("env", "backend", "seeds", "devices", "begun"),
    [("ball_in_cup", "host", 2, 2, 80), ("cartpole_swingup", "mjx", 2, 1, 120), ("ball_in_cup", "host", 1, 1, 120)],
    ids=["members within processes", "seeds across processes", "members across processes"],
)
def test_several_processes_are_one_with_as_many_devices(env, backend, seeds, devices, begun, start, tmp_path):
    """Also where one goes on with what several have begun, on as many devices or on half of them."""
    count, task = 2, (f"env={env}", f"backend={backend}", f"num_seeds={seeds}")
    ended = end(start(count, *task, f"total_steps={begun}", "run_dir=several", devices=devices))
    assert [status for status, _, _ in ended] == [0] * count, ended
    said = [output for _, output, _ in ended]
    assert f"on {count * devices} cpu device(s)" in said[0]
    assert f"saved at step {begun}" in said[0]
    assert not any("step" in others for others in said[1:])  # the first one speaks (and Gloo, for all)
    alone(count * devices, tmp_path, *task, "total_steps=120", "run_dir=alone")
    if begun < 120:
        shutil.copytree(tmp_path / "several", tmp_path / "fewer")
        for run_dir, left in (("several", count * devices), ("fewer", devices)):
            alone(left, tmp_path, *task, "total_steps=120", f"run_dir={run_dir}")
        check_nearly_same_end(tmp_path / "fewer", tmp_path / "alone")
    check_same_end(tmp_path / "several", tmp_path / "alone")
    assert "distributed: ''" in (tmp_path / "several" / "config.yaml").read_text()


@pytest.mark.slow
def test_a_run_goes_on_in_any_number_of_processes(start, tmp_path):
    """One process, then four, then two, with four devices always: as one process alone, to the bit."""
    task = ("env=ball_in_cup", "backend=host", "num_seeds=4")
    alone(4, tmp_path, *task, "total_steps=40", "run_dir=several")
    for count, steps in ((4, 80), (2, 120)):
        ended = end(start(count, *task, f"total_steps={steps}", "run_dir=several", devices=4 // count))
        assert [status for status, _, _ in ended] == [0] * count, ended
    alone(4, tmp_path, *task, "total_steps=120", "run_dir=alone")
    check_same_end(tmp_path / "several", tmp_path / "alone")


LONG = ("env=ball_in_cup", "backend=host", "total_steps=1000000", "run_dir=run")


@pytest.fixture
def begun(start, tmp_path):
    """Starts a long run of two processes, or goes on with it, and waits for an epoch."""

    def begin():
        epochs = tmp_path / "run" / jsonl.METRICS_FILE
        before = len(jsonl.read(epochs)) if epochs.exists() else 0
        running = start(2, *LONG)
        deadline = time.monotonic() + 300
        while not epochs.exists() or len(jsonl.read(epochs)) == before:
            assert all(process.poll() is None for process in running)
            assert time.monotonic() < deadline
            time.sleep(0.2)
        return running

    return begin


def last_words(running, left):
    """What the one that is left says on stderr, but for what it waits for at the start."""
    status, _, errors = end(running)[left]
    assert status != 0
    return [line for line in errors.splitlines() if "waiting for the other processes" not in line]


def test_a_signal_to_one_stops_all_and_where_one_is_gone_the_other_ends(begun, tmp_path):
    running = begun()
    running[1].send_signal(signal.SIGTERM)
    ended = end(running)
    assert [status for status, _, _ in ended] == [128 + signal.SIGTERM] * 2, ended
    assert "to continue: the same command again" in ended[0][1]
    steps = max(int(path.name) for path in (tmp_path / "run" / "checkpoints").iterdir())
    assert jsonl.read(tmp_path / "run" / jsonl.EPISODES_FILE)[-1]["env_steps"] <= steps

    running = begun()  # from there
    running[1].kill()
    (line,) = last_words(running, left=0)
    assert line.startswith("vecpsmbpo: another process of the run is gone (")
    assert "same command again" in line


@pytest.mark.slow
def test_where_the_first_one_is_gone_the_other_ends(begun):
    """jax, whose coordinator is in it, speaks of it beside us."""
    running = begun()
    running[0].kill()
    (line,) = [line for line in last_words(running, left=1) if line.startswith("vecpsmbpo: ")]
    assert "another process of the run" in line
    assert "same command again" in line


def test_what_fails_in_one_fails_in_all(start, tmp_path):
    """Two runs in one directory, and processes that were not started alike: one line in each."""
    first = start(1, *LONG)
    while not (tmp_path / "run" / "config.yaml").exists():
        assert first[0].poll() is None
        time.sleep(0.2)
    ended = end(start(2, *LONG))
    assert [status for status, _, _ in ended] == [2, 1], ended
    assert "vecpsmbpo: run_dir=run: another process is training in it" in ended[0][2]
    assert "vecpsmbpo: another process of the run has failed" in ended[1][2]


def test_a_grid_is_not_one_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", "-m", "seed=0,1", "distributed=auto"]) == 2
    assert capsys.readouterr().err == "vecpsmbpo: distributed: is of a single run, and not of a grid (-m)\n"


@pytest.mark.parametrize(
    "wrong", ["maybe", "a/0/2", "a:12/2/2", ":12/0/1", "a:12/0", "a:0/0/1", "a:65536/0/1", "a:12/0/2/3", "a:1/x/2"]
)
def test_an_address_that_is_none(wrong):
    with pytest.raises(SettingError, match=r"^distributed=.*: must be auto, or host:port/index/processes"):
        processes.join(wrong)


@pytest.fixture
def nobody_comes(monkeypatch):
    """jax waits until the test is over."""
    over = threading.Event()
    monkeypatch.setattr(jax.distributed, "initialize", lambda **_: over.wait())
    monkeypatch.setattr(processes, "PATIENCE_S", 0.02)
    monkeypatch.setattr(processes, "SILENCE_S", 0.01)
    yield
    over.set()


def test_others_that_do_not_come_are_waited_for_and_given_up(nobody_comes, capsys):
    with socket.socket() as process_0:
        process_0.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{process_0.getsockname()[1]}"

        def given_up(index):
            with pytest.raises(processes.NotTogether) as found:
                processes._initialize("x", processes._address(f"{address}/{index}/2"))
            waiting = capsys.readouterr().err
            assert waiting.startswith("vecpsmbpo: waiting for the other processes of the run")
            assert waiting.count("\n") == 1
            assert (address in waiting) == bool(index)
            return str(found.value)

        assert given_up(1) == f"distributed=x: nobody answers at {address}, after 0.02 s"
        process_0.listen()
        for index in (0, 1):
            assert given_up(index) == "distributed=x: the others have not all come, after 0.02 s"


def test_processes_that_have_not_come_end_the_program_at_once(monkeypatch, capsys):
    """The thread that waits for them would hold it up."""

    def alone(settings):
        raise processes.NotTogether("distributed=x: nobody answers")

    monkeypatch.setattr(training, "train", alone)
    assert cli._run(None) == (2, False)
    assert capsys.readouterr().err == "vecpsmbpo: distributed=x: nobody answers\n"


def test_without_a_cluster_there_are_no_others_to_be_found(monkeypatch):
    def fails(*_):
        raise ValueError("coordinator_address should be defined.")

    monkeypatch.setattr(jax.config, "update", lambda *_: None)
    monkeypatch.setattr(processes, "_initialize", fails)
    with pytest.raises(SettingError, match=r"^distributed=auto: jax finds no cluster here"):
        processes.join("auto")


def test_a_task_on_a_device_of_another_process_is_one_line(monkeypatch):
    """What jax says where a constant of a program lies there."""
    with pytest.raises(RuntimeError, match="non-addressable"), processes.noticing_the_lost():
        raise RuntimeError("Closing over jax.Array that spans non-addressable devices is not allowed.")
    monkeypatch.setattr(processes, "are_several", lambda: True)
    with pytest.raises(SettingError, match=r"^distributed: the task keeps arrays"), processes.noticing_the_lost():
        raise RuntimeError("Closing over jax.Array that spans non-addressable devices is not allowed.")


@pytest.mark.parametrize("here", [True, False])
def test_a_simulator_that_fails_in_one_process_fails_in_all(here, monkeypatch):
    class Failing:
        def step(self, action):
            if here:
                raise SimulatorError("out of coal")
            return "a step"

    if not here:
        assert host._in_all(lambda: Failing().step(None)) == "a step"
    monkeypatch.setattr(processes, "greatest", lambda failed: 1)
    with pytest.raises(SimulatorError, match="out of coal" if here else "failed in another process"):
        host._in_all(lambda: Failing().step(None))
