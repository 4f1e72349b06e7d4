"""Where MuJoCo's warnings go: to `logging`, not into a MUJOCO_LOG.TXT in the user's working directory."""

import logging

import mujoco

_LOG = logging.getLogger("mujoco")


def _warn(text: str) -> None:
    # That a model file of another package uses an old attribute is nothing its user here could mend.
    _LOG.log(logging.DEBUG if "deprecated" in text else logging.WARNING, text)


def redirect() -> None:
    """From now on, in this process."""
    mujoco.set_mju_user_warning(_warn)
