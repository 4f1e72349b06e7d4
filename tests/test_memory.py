"""Memory that the system does not give: one line, and what was saved stays."""

import errno
import resource
import subprocess
import sys

import jax
import pytest

from tests.helpers import environment
from vecpsmbpo import limits
from vecpsmbpo.settings import SettingError
from vecpsmbpo.training.guards import OutOfMemory, memory_errors

NOT_GIVEN = [
    MemoryError(),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
    RuntimeError("can't start new thread"),
    SystemError("<built-in method execute> returned NULL without exception set"),
    jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 4096 bytes"),
]
OTHERS = [
    OSError(errno.ENOSPC, "No space left on device"),
    RuntimeError("cannot enter a frozen module"),
    SystemError("bad argument to internal function"),
    jax.errors.JaxRuntimeError("INVALID_ARGUMENT: shapes"),
    ValueError("memory"),
]


@pytest.mark.parametrize("error", NOT_GIVEN, ids=repr)
def test_memory_that_is_not_given_is_one_line(error, tmp_path):
    with pytest.raises(OutOfMemory) as told, memory_errors(tmp_path):
        raise error
    assert str(told.value).startswith(f"run_dir={tmp_path}: out of memory ({type(error).__name__}")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("error", OTHERS, ids=repr)
def test_other_errors_stay_what_they_are(error, tmp_path):
    with pytest.raises(type(error)) as told, memory_errors(tmp_path):
        raise error
    assert told.value is error


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
    shell = ["bash", "-c", limited]
    result = subprocess.run(shell, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.startswith(f"vecpsmbpo: {line}")
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
