"""Which versions are at work: what every report of a fault has to say. Imports none of them."""

import os
import platform
import re
from importlib import metadata
from pathlib import Path

PACKAGES = ("vecpsmbpo", "jax", "mujoco")


def current() -> dict[str, str]:
    """Version by name: this package, those whose versions decide whether it runs, and Python."""
    return {**{name: _version(name) for name in PACKAGES}, "python": platform.python_version()}


def line() -> str:
    return ", ".join(f"{name} {version}" for name, version in current().items())


def machine() -> str:
    """The computer in words: its processor, as Linux calls it, and how many cores it has."""
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return f"{found[1] if found else platform.machine()}, {os.cpu_count()} cores"


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
