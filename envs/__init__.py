"""The tasks, on MJX and on their original simulators. `make` is the way in."""

from vecpsmbpo.envs.registry import make

__all__ = ["make"]
