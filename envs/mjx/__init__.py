"""MJX ports, one file per task, each a `brax.envs.base.Env`."""

import contextlib
import io

from vecpsmbpo.envs import mujoco_log

# MJX's import says on stdout that Warp is not installed. Nothing here uses Warp.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401

mujoco_log.redirect()
