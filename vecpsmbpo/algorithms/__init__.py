"""The algorithms by name: a folder each, with its own settings, over the functions of `base.Algorithm`.

Knows their settings; what learns, and JAX with it, is imported when it is to be made (`programs`).
"""

from typing import NamedTuple

from vecpsmbpo.algorithms.pets.settings import PetsSettings
from vecpsmbpo.algorithms.ps_mbpo.settings import PsMbpoSettings, RealDataSettings
from vecpsmbpo.algorithms.slbo.settings import SlboSettings
from vecpsmbpo.settings import Settings


class Entry(NamedTuple):
    """An algorithm.

    Attributes:
        title: its name in the literature.
        settings: the class of its settings.
        learner: `module:class` of what learns.
        format: of its checkpoints; a state that gains or loses fields has another one.
    """

    title: str
    settings: type[Settings]
    learner: str
    format: int


_PS_MBPO = Entry("PS-MBPO", PsMbpoSettings, "vecpsmbpo.algorithms.ps_mbpo.algorithm:PsMbpo", format=4)

# In the order of legends and tables, which is the paper's.
TABLE = {
    "ops_mbpo": _PS_MBPO._replace(title="OPS-MBPO"),
    "ps_mbpo": _PS_MBPO,
    "mbpo": _PS_MBPO._replace(title="MBPO"),
    "slbo": Entry("SLBO", SlboSettings, "vecpsmbpo.algorithms.slbo.algorithm:Slbo", format=6),
    "pets": Entry("PETS", PetsSettings, "vecpsmbpo.algorithms.pets.algorithm:Pets", format=6),
    "sac": _PS_MBPO._replace(title="SAC", settings=RealDataSettings),
}
