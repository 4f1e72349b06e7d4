"""Settings as a run keeps them, in `config.yaml` and in every checkpoint: what was, against what is asked for now."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from vecpsmbpo.settings import SettingError, Settings

SHOWN = 6  # contradictions that a line names

# Settings that there were, and the value with which they did nothing.
RETIRED = {
    "policy_learning_rate_decay": 1.0,
    "clip_targets": False,
    "bound_log_prob": False,
    "target_update_every": 1,
}


def plain(settings: Settings) -> dict[str, Any]:
    """Value by name, in the types of JSON and YAML."""
    values = dataclasses.asdict(settings)
    values["env_options"] = dict(settings.env_options)
    values["sweep"] = {name: list(swept) for name, swept in settings.sweep}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def check(settings: Settings, record: Mapping[str, Any]) -> None:
    """That a checkpoint was made with these settings, where both know them.

    Args:
        record: what `plain` gave when it was made.

    Raises:
        SettingError: some differ that may not.
    """
    wrong = [
        f"{name}={record[name]} (not {value})"
        for name, value in plain(settings).items()
        if name != "run_dir" and not settings.may_change(name) and record.get(name, value) != value
    ]
    if wrong:
        more = [f"{len(wrong) - SHOWN} more"] if len(wrong) > SHOWN else []
        raise SettingError(
            f"run_dir={settings.run_dir}: its checkpoints were made with {', '.join(wrong[:SHOWN] + more)}; "
            "put config.yaml right, or give another run_dir"
        )


def check_retired(settings: Settings, record: Mapping[str, Any]) -> None:
    """That a checkpoint can be trained on: that it was not made with what this version does not have.

    Raises:
        SettingError: it was.
    """
    gone = [f"{name}={record[name]}" for name, off in RETIRED.items() if record.get(name, off) != off]
    if gone:
        raise SettingError(
            f"run_dir={settings.run_dir}: was trained with {', '.join(gone)}, which is no setting any more; it can be "
            "looked at and evaluated, not resumed"
        )
