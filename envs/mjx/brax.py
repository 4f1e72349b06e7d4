"""Brax's own environments."""

from brax import envs as brax_envs
from brax.envs.base import Env

from vecpsmbpo.envs import termination
from vecpsmbpo.envs.mjx.adapter import Adapter
from vecpsmbpo.settings import SettingError

EPISODE_LENGTH = 1000  # Brax's default; it registers none
NEVER_TERMINATE = frozenset({"fast", "halfcheetah", "humanoidstandup", "pusher", "reacher", "swimmer"})


def any_task(*, id: str) -> Env:
    """A registered Brax environment, such as `reacher`, on Brax's default physics backend.

    Raises:
        SettingError: there is none of that name.
    """
    try:
        inner = brax_envs.get_environment(id)
    except KeyError:
        known = ", ".join(sorted(brax_envs._envs))
        raise SettingError(f"env.id={id}: must be one of {known}") from None
    rule = termination.never if id in NEVER_TERMINATE else None
    return Adapter(inner, f"env.id={id}", id, EPISODE_LENGTH, rule)
