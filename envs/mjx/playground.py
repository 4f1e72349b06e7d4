"""MuJoCo Playground's environments (an optional package)."""

from brax.envs.base import Env
from mujoco_playground import registry

from vecpsmbpo.envs import termination
from vecpsmbpo.envs.mjx.adapter import Adapter
from vecpsmbpo.settings import SettingError


def any_task(*, id: str) -> Env:
    """A Playground environment, such as `CheetahRun`. Those of the control suite never terminate; of others
    termination is learned.

    Raises:
        SettingError: there is none of that name, or its observations are not one vector.
    """
    if id not in registry.ALL_ENVS:
        raise SettingError(f"env.id={id}: must be one of {', '.join(sorted(registry.ALL_ENVS))}")
    options = registry.get_default_config(id)
    if "impl" in options:
        options.impl = "jax"
    rule = termination.never if id in registry.dm_control_suite.ALL_ENVS else None
    inner, repeat = registry.load(id, config=options), options.get("action_repeat", 1)
    return Adapter(inner, f"env.id={id}", id, options.episode_length, rule, action_repeat=repeat)
