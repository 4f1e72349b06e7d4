"""Anybody's own task, from outside of this package."""

import importlib
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec


def load(path: str) -> Any:
    """What `path`, `package.module:attribute`, makes when it is called without arguments.

    The working directory is searched, too.

    Raises:
        SettingError: it cannot be imported, or it fails.
    """
    module, colon, attribute = path.partition(":")
    if not colon or not attribute:
        raise SettingError(f"env.make={path}: must be package.module:attribute")
    if (here := str(Path.cwd())) not in sys.path:
        sys.path.insert(0, here)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise SettingError(f"env.make={path}: {error}") from None
    if not callable(found):
        raise SettingError(f"env.make={path}: is {found!r}, which makes nothing when it is called"[:300])
    return found()


def check_rule(spec: EnvSpec, label: str) -> None:
    """That the termination rule, where there is one, answers for each of a batch: a mistake shows here, and not in the
    first rollout.

    Raises:
        SettingError: it does not.
        BaseException: whatever the rule raises.
    """
    if spec.terminated is None:
        return
    batch = 7  # any, but no size of the task's own
    obs, action = (jax.ShapeDtypeStruct((batch, size), jnp.float32) for size in (spec.obs_size, spec.action_size))
    answer = jax.eval_shape(spec.terminated, obs, action, obs)
    found = [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(answer)]
    if found != [((batch,), "bool")]:
        what = " and ".join(f"{dtype}{list(shape)}" for shape, dtype in found) or "nothing"
        raise SettingError(f"{label}: its termination rule gives {what} for {batch} transitions, not bool[{batch}]")
