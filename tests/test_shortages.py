"""What the system does not give, memory or files: one line, and what was saved stays."""

import contextlib
import errno
import os
import resource
import subprocess
import sys

import jax
import pytest

from tests.helpers import environment, tiny
from vecpsmbpo import checkpoint, limits, shortages
from vecpsmbpo.checkpoint import Checkpoints
from vecpsmbpo.settings import SettingError
from vecpsmbpo.stopping import Stop
from vecpsmbpo.sweeps.job import Run, train
from vecpsmbpo.training.guards import DiskError, OutOfMemory, disk_errors, memory_errors

TENSORSTORE = "RESOURCE_EXHAUSTED: Error opening local file: Too many open files [os_error_code='24']"
NUMBERS = [
    (MemoryError(), errno.ENOMEM),
    (OSError(errno.ENOMEM, "Cannot allocate memory"), errno.ENOMEM),
    (RuntimeError("can't start new thread"), errno.ENOMEM),
    (SystemError("<built-in method execute> returned NULL without exception set"), errno.ENOMEM),
    (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 4096 bytes"), errno.ENOMEM),
    (ValueError(TENSORSTORE), errno.EMFILE),
    (ValueError("RESOURCE_EXHAUSTED: writing"), errno.ENOSPC),
    (OSError(errno.ENOSPC, "No space left on device"), errno.ENOSPC),
    (RuntimeError("cannot enter a frozen module"), None),
    (SystemError("bad argument to internal function"), None),
    (jax.errors.JaxRuntimeError("INVALID_ARGUMENT: shapes"), None),
    (ValueError("DATA_LOSS: memory"), None),
]


@pytest.mark.parametrize(("error", "number"), NUMBERS, ids=lambda value: repr(value)[:50])
def test_every_way_to_say_it_is_understood(error, number, tmp_path):
    assert shortages.number_of(error) == number
    kind = type(error)
    if number == errno.ENOMEM:
        kind, line = OutOfMemory, f"run_dir={tmp_path}: out of memory ({type(error).__name__}"
    elif number:
        kind, line = DiskError, f"run_dir={tmp_path}: cannot be written ({os.strerror(number)})"
    with pytest.raises(kind) as told, memory_errors(tmp_path), disk_errors(tmp_path):
        raise error
    if number:
        assert str(told.value).startswith(line)
        assert "\n" not in str(told.value)
    else:
        assert told.value is error


@pytest.mark.parametrize("error", [ValueError(TENSORSTORE), MemoryError(), OSError(errno.EIO, "Input/output error")])
def test_a_checkpoint_that_the_system_does_not_let_be_read_is_not_a_damaged_one(error, tmp_path, monkeypatch):
    """Or an older one would be taken, and this one removed."""

    def read(self, step, shapes, layout):
        raise error

    settings = tiny(run_dir=str(tmp_path))
    checkpoints = Checkpoints(tmp_path / checkpoint.FOLDER, settings)
    monkeypatch.setattr(Checkpoints, "steps", lambda self: [40])
    monkeypatch.setattr(Checkpoints, "_read", read)
    warnings: list[str] = []
    with pytest.raises(OSError, match="checkpoints/40") as told:
        checkpoints.restore(None, None, warn=warnings.append)
    assert told.value.errno == shortages.number_of(error)
    assert (warnings, checkpoints._damaged) == ([], [])
    checkpoints.close()


def test_a_job_of_a_grid_looks_at_the_limit_before_it_imports_jax(tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "free_address_space", lambda: 2**30)
    monkeypatch.chdir(tmp_path)
    outcome = train(Run(tiny(run_dir="run"), tmp_path), contextlib.nullcontext(Stop()))
    assert outcome.status == 2
    assert outcome.said.startswith("this process may take 1.00 GiB")
    assert not list(tmp_path.iterdir())


def test_free_address_space_is_the_limit_less_what_is_taken(monkeypatch):
    with open("/proc/self/status") as file:
        taken = next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmSize"))
    monkeypatch.setattr(resource, "getrlimit", lambda which: (taken + 2**30, taken + 2**30))
    assert limits.free_address_space() == pytest.approx(2**30, abs=2**24)
    with pytest.raises(SettingError, match=r"may take 1\.0\d? GiB|may take 0\.9\d GiB"):
        limits.check_start()


@pytest.mark.parametrize(("limit_mb", "line"), [(900, "this process may take 0."), (3000, "not enough memory: ")])
def test_a_limit_on_address_space_is_one_line_before_anything_is_made(limit_mb, line, tmp_path):
    """With 900 MiB OpenBLAS would ask for memory again for ever."""
    limited = f"ulimit -v {limit_mb * 1024}; exec {sys.executable} -m vecpsmbpo.cli train size=tiny backend=host"
    how = {"cwd": tmp_path, "env": environment(), "capture_output": True, "text": True, "timeout": 120, "check": False}
    result = subprocess.run(["bash", "-c", limited], **how)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"vecpsmbpo: {line}")
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_too_few_open_files_are_one_line(tmp_path):
    limited = (
        f"ulimit -n 16; exec {sys.executable} -m vecpsmbpo.cli train env=ball_in_cup size=tiny backend=host run_dir=x"
    )
    result = subprocess.run(["bash", "-c", limited], cwd=tmp_path, env=environment(), capture_output=True, text=True)
    assert (result.returncode, result.stderr) == (
        2,
        f"vecpsmbpo: run_dir=x: cannot be written ({os.strerror(errno.EMFILE)})\n",
    )
