"""What tools/setup.sh says before it installs anything, and what it installs: asked of interpreters that pretend."""

import re
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from tests.helpers import PROJECT, pinned

ROOT = Path(__file__).parents[1]
DM_CONTROL = pinned("dm-control")

# An interpreter of `version` that writes down what pip is asked for. `venv` makes another of itself.
PYTHON = """#!/bin/sh
case "$*" in
    *version_info*) echo {version} ;;
    *ensurepip*) {ensurepip} ;;
    "-m venv .venv") mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
    "-m pip "*) echo "$*" >> pip.log ;;
esac
"""


@pytest.fixture
def checkout(tmp_path):
    """One with a command that sources setup.sh, and a PATH on which there is no interpreter yet."""
    (tmp_path / "tools").mkdir()
    (tmp_path / "bin").mkdir()
    for name in ("tools/setup.sh", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    command = tmp_path / "tools" / "command"
    command.write_text('set -euo pipefail\nsource "$(dirname "${BASH_SOURCE[0]}")/setup.sh" "[dev]"\n')
    for tool in ("bash", "dirname", "mkdir", "cp", "rm", "sed", "sh"):
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool))
    return tmp_path


def interpreter(checkout: Path, name: str, version: str, ensurepip: bool = True) -> None:
    path = checkout / "bin" / name
    path.write_text(PYTHON.format(version=version, ensurepip="exit 0" if ensurepip else "exit 1"))
    path.chmod(0o755)


def run(checkout: Path, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [checkout / "bin" / "bash", "tools/command"],
        cwd=checkout,
        env={"PATH": str(checkout / "bin"), **environment},
        capture_output=True,
        text=True,
        timeout=60,
    )


def assert_one_line(result: subprocess.CompletedProcess, *parts: str) -> None:
    assert result.returncode == 2
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("tools/command: ")
    for part in parts:
        assert part in result.stderr


def test_setup_and_pyproject_mean_the_same_versions():
    supported = re.search(r'^supported="(.*)" ', (ROOT / "tools" / "setup.sh").read_text(), re.MULTILINE).group(1)
    minors = [int(version.removeprefix("3.")) for version in supported.split()]
    assert PROJECT["requires-python"] == f">=3.{minors[0]},<3.{minors[-1] + 1}"
    assert minors == list(range(minors[0], minors[-1] + 1))
    assert sys.version_info[1] in minors


@pytest.mark.parametrize(
    ("version", "dm_control"), [("3.11", []), ("3.12", []), ("3.13", [f"install --no-deps {DM_CONTROL}"])]
)
def test_a_supported_python_installs_everything(checkout, version, dm_control):
    interpreter(checkout, "python3", version)
    result = run(checkout)
    assert (result.returncode, result.stderr) == (0, "")
    asked = (
        (checkout / "pip.log").read_text().replace("-m pip ", "").replace("--quiet --disable-pip-version-check ", "")
    )
    assert asked.splitlines() == ["install --use-pep517 --editable .[dev]", *dm_control]


def test_another_python_is_looked_for_where_python3_will_not_do(checkout):
    interpreter(checkout, "python3", "3.9")
    interpreter(checkout, "python3.13", "3.13", ensurepip=False)
    interpreter(checkout, "python3.12", "3.12")
    assert run(checkout).returncode == 0
    made = subprocess.run([checkout / ".venv" / "bin" / "python", "version_info"], capture_output=True, text=True)
    assert made.stdout == "3.12\n"


def test_no_supported_python_is_one_line(checkout):
    interpreter(checkout, "python3", "3.14")
    assert_one_line(run(checkout), "needs one of Python 3.11, 3.12, 3.13; python3 is 3.14; ", "PYTHON=/path/to/python")
    assert not (checkout / ".venv").exists()


def test_no_python_at_all_is_one_line(checkout):
    assert_one_line(run(checkout), "needs one of Python 3.11, 3.12, 3.13; install one")


def test_a_python_that_was_asked_for_is_the_only_one_tried(checkout):
    interpreter(checkout, "python3", "3.12")
    assert_one_line(run(checkout, PYTHON="python9"), "python9 does not run")


def test_a_python_without_venv_is_one_line(checkout):
    interpreter(checkout, "python3", "3.11", ensurepip=False)
    assert_one_line(run(checkout), "python3 cannot make virtual environments", "apt install python3.11-venv")
    assert not (checkout / ".venv").exists()


def test_an_environment_of_another_python_is_one_line(checkout):
    interpreter(checkout, "python3", "3.12")
    interpreter(checkout, "old", "3.10")
    (checkout / ".venv" / "bin").mkdir(parents=True)
    (checkout / "bin" / "old").rename(checkout / ".venv" / "bin" / "python")
    assert_one_line(run(checkout), "rm -r .venv")
    assert not (checkout / "pip.log").exists()


def test_what_dm_control_needs_is_installed_where_it_is_left_out():
    """Its own requirements, but for labmaze and what this package depends on everywhere."""
    ours = {_name(text) for text in PROJECT["dependencies"]} | {"numpy"}  # numpy: of everything
    theirs = {_name(text) for text in metadata.requires("dm-control") if "extra ==" not in text}
    assert theirs - ours == {"labmaze"}


def _name(requirement: str) -> str:
    return re.match(r"[\w-]+", requirement).group().lower().replace("_", "-")
