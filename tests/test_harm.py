"""What `tools/faults` does harm with, and its table."""

import errno
import os
import shutil
import subprocess
import sys

import pytest

from tests.helpers import environment
from tools import faults
from tools.harm import writes

WRITING = """
import os, sys
for act in (
    lambda: os.mkdir("below/a"),
    lambda: open("below/a/b", "wb", buffering=0).write(b"x"),
    lambda: os.fsync(os.open("below/a/b", os.O_WRONLY)),
    lambda: os.rename("below/a/b", "below/a/c"),
    lambda: open("below/a/c").read() + open("beside", "w").name,
):
    try:
        act()
    except OSError as error:
        print(error.errno)
"""


@pytest.mark.skipif(sys.platform != "linux" or shutil.which("gcc") is None, reason="needs gcc and LD_PRELOAD")
def test_one_write_below_a_directory_can_be_made_to_fail(tmp_path):
    """What tools/faults makes of writes.c."""
    shim = tmp_path / "writes.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", shim, writes.SHIM, "-ldl"], check=True)
    told = {"LD_PRELOAD": str(shim), "WRITES_BELOW": str(tmp_path / "below"), "WRITES_LOG": str(tmp_path / "log")}
    seen = ["mkdir a", "open a/b", "write a/b", "open a/b", "sync a/b", "rename a/c"]
    for number in range(len(seen) + 1):
        shutil.rmtree(tmp_path / "below", ignore_errors=True)
        (tmp_path / "below").mkdir()
        (tmp_path / "log").unlink(missing_ok=True)
        surroundings = {**environment(), **told, "WRITES_FAIL": str(number), "WRITES_ERROR": str(errno.EIO)}
        program = [os.path.realpath(sys.executable), "-c", WRITING]
        result = subprocess.run(program, cwd=tmp_path, env=surroundings, capture_output=True, text=True, check=True)
        errors = result.stdout.split()
        assert errors[:1] == ([str(errno.EIO)] if number else [])
        lines = (tmp_path / "log").read_text().splitlines()
        assert lines[:number] == seen[:number]
        assert number or lines == seen


def test_each_kind_of_write_is_tried():
    array = "checkpoints/120.orbax-checkpoint-tmp/state.orbax-checkpoint-tmp/real.0"
    kinds = [writes._kind_of_write(f"write {array}/{name}") for name in ("0.0", "0.0.__lock", "1.0", ".zarray")]
    assert kinds == [f"write checkpoints/state/array/{name}" for name in ("part", "part__lock", "part", ".zarray")]
    assert writes._kind_of_write("open .config.4711.yaml") == "open .config.#.yaml"
    full, broken = errno.ENOSPC, errno.EIO
    assert writes._chosen(["a", "b", *"aaaa"], more=2) == [
        (1, "a, first of 5", full),
        (2, "b, first of 1", broken),
        (4, "a, middle of 5", full),
        (6, "a, last of 5", broken),
        (5, "what is written 75.8% of the way", full),
        (2, "b, first of 1", full),  # b has met a full disk, too
    ]


def test_the_table_of_faults_has_what_is_tried_and_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(faults, "OUT", tmp_path / "faults.csv")
    row = {"ended": "same end", "commit": "a", "versions": "b"}
    faults.keep("files", ["of old", "first"], {"what": "of old", **row})
    faults.keep("twice", ["other"], {"what": "other", **row})
    for what, ended in (("second", "same end"), ("first", "another end"), ("first", "same end")):
        faults.keep("files", ["first", "second"], {**row, "what": what, "ended": ended})
    lines = ["part,what,ended,commit,versions", *(f"{name},same end,a,b" for name in ("files,first", "files,second"))]
    assert faults.OUT.read_text().splitlines() == [*lines, "twice,other,same end,a,b"]


def test_what_a_machine_has_not_for_a_part_of_tools_faults_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(faults, "OUT", tmp_path / "faults.csv")
    monkeypatch.setenv("PATH", str(tmp_path))  # no gcc, no mount, no git
    assert faults.main(["part=writes,disk"]) == 1
    writing, mounting = capsys.readouterr().out.splitlines()
    assert writing.startswith("writes: not tried: needs gcc")
    assert mounting.startswith("disk: not tried: disks cannot be mounted here (")
    assert not faults.OUT.exists()
