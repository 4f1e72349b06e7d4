"""The original simulators behind one batched interface: the fallback for tasks that MJX cannot run."""

from vecpsmbpo.envs import mujoco_log

mujoco_log.redirect()
