"""The states that runs of one task have visited, in a common plane (figures 8, 18 and 19)."""

import importlib.util
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vecpsmbpo.look.runs import Run
from vecpsmbpo.settings import SettingError

Array = np.ndarray

ROWS = 2000  # of a lane: UMAP's time grows with them, and more dots than this are a blot


class Visited(NamedTuple):
    """States of one run's lanes.

    Attributes:
        run: whose.
        steps: when each was visited, [V].
        obs: [V, O].
    """

    run: Run
    steps: Array
    obs: Array


def check_umap() -> None:
    """Says so where the package is absent, before anything long begins.

    Raises:
        SettingError: it is.
    """
    if importlib.util.find_spec("umap") is None:
        raise SettingError("figure: this one needs umap-learn; pip install 'vecpsmbpo[umap]'")


def visited(run: Run) -> Visited:
    """D_E of the run's newest checkpoint, thinned to `ROWS` per lane.

    Raises:
        SettingError: it holds no checkpoint.
    """
    from vecpsmbpo.evaluate import restore  # and JAX with it

    driver, saved = restore(run.settings)
    rings = np.asarray(saved.state.seeds.real)
    oldest = max(0, saved.step - rings.shape[1])
    steps = np.unique(np.linspace(oldest, saved.step - 1, ROWS).astype(int))
    size = driver.algorithm.spec.obs_size
    obs = np.concatenate([ring[steps % len(ring), :size] for ring in rings])
    return Visited(run, np.tile(steps, len(rings)), obs)


def plane(states: Sequence[Visited]) -> list[Array]:
    """UMAP of all states together, each coordinate in units of its deviation: [V, 2] for each."""
    import umap

    obs = np.concatenate([one.obs for one in states])
    spread = obs.std(axis=0)
    places = umap.UMAP(random_state=0, n_jobs=1).fit_transform(
        (obs - obs.mean(axis=0)) / np.where(spread > 0, spread, 1)
    )
    ends = np.cumsum([len(one.obs) for one in states])
    return np.split(places, ends[:-1])
