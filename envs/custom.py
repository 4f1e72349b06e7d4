"""Anybody's own task, from outside of this package."""

import importlib
import sys
from pathlib import Path
from typing import Any

from vecpsmbpo.settings import SettingError


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
