"""The tasks, on MJX and on their original simulators. `make` is the way in."""

import os

from vecpsmbpo.envs.registry import make

# Training draws no pictures; without this, dm_control looks for a display and warns.
os.environ.setdefault("MUJOCO_GL", "disabled")

__all__ = ["make"]
