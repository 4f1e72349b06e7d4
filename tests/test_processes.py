"""One run over several processes, on this machine: the same as in one process with as many devices, to the bit."""

import json
import re
import signal
import socket
import subprocess
import time

import pytest

from tests.helpers import argv, environment
from tests.test_resume import without_times
from vecpsmbpo import jsonl, processes
from vecpsmbpo.settings import SettingError

RUN = ("train", "size=tiny", "loggers=[]")
DEVICES = "--xla_force_host_platform_device_count={} --xla_cpu_multi_thread_eigen=false"


def start(count, cwd, *words):
    """The processes of a run, one device each."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    where = {"cwd": cwd, "env": {**environment(), "XLA_FLAGS": DEVICES.format(1)}, "text": True}
    return [
        subprocess.Popen(
            argv(*RUN, *words, f"distributed=127.0.0.1:{port}/{index}/{count}"),
            **where,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for index in range(count)
    ]


def end(running):
    """Exit status, stdout and stderr of each."""
    said = [process.communicate(timeout=500) for process in running]
    return [(process.returncode, *texts) for process, texts in zip(running, said, strict=True)]


def alone(devices, cwd, *words):
    flags = {**environment(), "XLA_FLAGS": DEVICES.format(devices)}
    done = subprocess.run(argv(*RUN, *words), cwd=cwd, env=flags, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def arrays(run_dir, step):
    """A checksum of the whole state."""
    return json.loads((run_dir / f"checkpoints/{step}/host/metadata").read_text())["arrays"]


@pytest.mark.parametrize(
    ("count", "task"),
    [
        (2, ("env=ball_in_cup", "backend=host")),
        pytest.param(4, ("env=cartpole_swingup", "num_seeds=2"), marks=pytest.mark.slow),
    ],
    ids=["host", "mjx"],
)
def test_several_processes_are_one_with_as_many_devices(count, task, tmp_path):
    """Also where one goes on with what several have begun."""
    ended = end(start(count, tmp_path, *task, "total_steps=80", "run_dir=several"))
    assert [status for status, _, _ in ended] == [0] * count, ended
    said = [output for _, output, _ in ended]
    assert f"on {count} cpu device(s)" in said[0]
    assert said[1:] == [""] * (count - 1)  # the first one speaks
    alone(count, tmp_path, *task, "total_steps=120", "run_dir=several")
    alone(count, tmp_path, *task, "total_steps=120", "run_dir=alone")
    several, one = tmp_path / "several", tmp_path / "alone"
    assert arrays(several, 120) == arrays(one, 120)
    for name in (jsonl.METRICS_FILE, jsonl.EPISODES_FILE):
        assert without_times(jsonl.read(several / name)) == without_times(jsonl.read(one / name))
    assert "distributed: ''" in (several / "config.yaml").read_text()


def test_a_process_that_dies_ends_the_run_and_a_signal_to_one_stops_all(tmp_path):
    words = ("env=ball_in_cup", "backend=host", "total_steps=1000000", "run_dir=run")

    def begun():
        running = start(2, tmp_path, *words)
        epochs = tmp_path / "run" / jsonl.METRICS_FILE
        before = len(jsonl.read(epochs)) if epochs.exists() else 0
        deadline = time.monotonic() + 300
        while not epochs.exists() or len(jsonl.read(epochs)) < before + 3:
            assert all(process.poll() is None for process in running), end(running)
            assert time.monotonic() < deadline
            time.sleep(0.2)
        return running

    running = begun()
    running[1].kill()
    (status, _, errors), _ = end(running)
    told = [line for line in errors.splitlines() if line.startswith("vecpsmbpo: ")]
    assert status == 1
    assert len(told) == 1
    assert re.search(r"another process of the run is gone .* saved at step \d+; to continue", told[0])
    assert "Traceback" not in errors

    running = begun()  # from the last checkpoint
    running[1].send_signal(signal.SIGTERM)
    ended = end(running)
    assert [status for status, _, _ in ended] == [128 + signal.SIGTERM] * 2
    assert "to continue" in ended[0][1]


@pytest.mark.parametrize("wrong", ["maybe", "a/0/2", "a:12/2/2", ":12/0/1", "a:12/0", "a:12/0/2/3", "a:1/x/2"])
def test_an_address_that_is_none(wrong):
    with pytest.raises(SettingError, match=r"^distributed=.*: must be auto, or host:port/index/processes"):
        processes.join(wrong)
