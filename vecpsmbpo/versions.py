"""Which versions are at work: what every report of a fault has to say. Imports none of them."""

import platform
from importlib import metadata

PACKAGES = ("vecpsmbpo", "jax", "mujoco")


def current() -> dict[str, str]:
    """Version by name: this package, those whose versions decide whether it runs, and Python."""
    return {**{name: _version(name) for name in PACKAGES}, "python": platform.python_version()}


def line() -> str:
    return ", ".join(f"{name} {version}" for name, version in current().items())


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"
