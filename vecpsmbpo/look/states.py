"""The states that runs of one task have visited, in a common plane (figures 8, 18 and 19)."""

import importlib.util
from collections.abc import Callable, Sequence
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


def has_umap() -> bool:
    return importlib.util.find_spec("umap") is not None


def check_umap() -> None:
    """Says so where the package is absent, before anything long begins.

    Raises:
        SettingError: it is.
    """
    if not has_umap():
        raise SettingError("figure: this one needs umap-learn; pip install 'vecpsmbpo[umap]'")


def visited(run: Run) -> Visited:
    """D_E of the run's newest checkpoint, thinned to `ROWS` per lane.

    Raises:
        SettingError: it holds no checkpoint.
    """
    from vecpsmbpo import health
    from vecpsmbpo.evaluate import restore  # and JAX with it

    driver, saved = restore(run.settings)
    rings = np.asarray(saved.state.seeds.real)
    oldest = max(0, saved.step - rings.shape[1])
    own = health.own_rows(saved.state.seeds.health, saved.step, run.settings.stride)
    steps = [np.unique(np.linspace(oldest, last - 1, min(ROWS, max(last - oldest, 0))).astype(int)) for last in own]
    size = driver.algorithm.spec.obs_size
    obs = np.concatenate([ring[at % len(ring), :size] for ring, at in zip(rings, steps, strict=True)])
    return Visited(run, np.concatenate(steps), obs)


def plane(clouds: Sequence[Array]) -> list[Array]:
    """UMAP of all states together, each coordinate in units of its deviation: clouds [V, O] each -> [V, 2] each."""
    import umap

    return _together(clouds, umap.UMAP(random_state=0, n_jobs=1).fit_transform)


def principal_plane(clouds: Sequence[Array]) -> list[Array]:
    """As `plane`, the first two principal components: nothing has to be installed for them."""

    def first_two(obs: Array) -> Array:
        _, _, axes = np.linalg.svd(obs, full_matrices=False)
        places = obs @ axes[:2].T
        return np.pad(places, ((0, 0), (0, 2 - places.shape[1])))

    return _together(clouds, first_two)


def _together(clouds: Sequence[Array], place: Callable[[Array], Array]) -> list[Array]:
    """What `place` makes of all states, whitened, for each cloud."""
    obs = np.concatenate(clouds)
    std = obs.std(axis=0)
    places = place((obs - obs.mean(axis=0)) / np.where(std > 0, std, 1))
    return np.split(places, np.cumsum([len(one) for one in clouds])[:-1])
