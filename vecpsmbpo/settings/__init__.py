"""Every setting of a run, with its type and range. Knows nothing of Hydra or JAX, so mistakes answer at once.

What each setting does is written beside its value in `configs/`; where a number comes from, too. `base` has what every
algorithm needs, `parts` what some share; the rest is in the algorithms' own folders.
"""

from vecpsmbpo.settings.base import CHANGEABLE, Settings
from vecpsmbpo.settings.fields import SettingError

__all__ = ["CHANGEABLE", "SettingError", "Settings"]
