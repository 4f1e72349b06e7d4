"""Training: the loop around the compiled program, and what stands around that loop."""

from vecpsmbpo.training.guards import DiskError, OutOfMemory, TaskFailed
from vecpsmbpo.training.loop import train

__all__ = ["DiskError", "OutOfMemory", "TaskFailed", "train"]
