"""`vecpsmbpo eval`: whole episodes of the run in `run_dir=`, or of the policy that export has written there.

What is not said is as the run has it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from vecpsmbpo.algorithms.catalogue import allowed, check
from vecpsmbpo.envs import registry
from vecpsmbpo.settings import SettingError, Settings


class Word(NamedTuple):
    """What may be told of an evaluation: the setting of the run that it stands for, and what it is for, in words."""

    setting: str
    what: str


EVALUATION = {
    "episodes": Word("eval_episodes", "of every seed and swept value"),
    "policy": Word("eval_policy", "whose: drawn now, the one of highest mean return, or the average of all"),
    "actions": Word("eval_actions", "of its action distribution"),
    "backend": Word("backend", "what the episodes are stepped with"),
    "devices": Word("devices", "how many to use; 0: every one that can be given work"),
}


def for_evaluation(stored: Settings, given: Mapping[str, Any]) -> Settings:
    """The settings of a run as it is to be evaluated.

    Args:
        given: values by the names in `EVALUATION`.

    Raises:
        SettingError: a name that there is not, or a value that it cannot have.
    """
    changes = {}
    for name, value in given.items():
        if name not in EVALUATION:
            raise SettingError(f"{name}={value}: evaluation takes {', '.join(EVALUATION)}")
        setting = EVALUATION[name].setting
        if not hasattr(stored, setting):
            raise SettingError(f"{name}={value}: there is no choice with algo={stored.algo}")
        try:
            changes[setting] = check(setting, value)
        except SettingError:
            raise SettingError(f"{name}={value}: must be {allowed(setting)}") from None
    changes["backend"] = registry.resolve_backend(stored.env, changes.get("backend", stored.backend))
    return dataclasses.replace(stored, **changes)
