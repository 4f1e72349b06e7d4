"""A folder per algorithm over the functions of `base.Algorithm`."""

from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.algorithms.pets.algorithm import Pets
from vecpsmbpo.algorithms.ps_mbpo.algorithm import PsMbpo
from vecpsmbpo.algorithms.slbo.algorithm import Slbo
from vecpsmbpo.layout import Layout
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import EnvSpec


def make(settings: Settings, spec: EnvSpec) -> Algorithm:
    """The algorithm that `algo=` names, on this process's devices."""
    chosen = Pets if settings.plans else Slbo if settings.alternates else PsMbpo
    return chosen(settings, spec, Layout.of(settings))
