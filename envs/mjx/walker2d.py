"""Gymnasium Walker2d-v4 on MJX."""

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.locomotion import UprightLocomotion


class Walker2d(UprightLocomotion):
    """Walk forward without falling."""

    spec = specs.get("walker2d")

    def __init__(self):
        super().__init__("walker2d.xml", substeps=4)
