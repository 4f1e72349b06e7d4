"""The real data of a run, D_E, as a Minari data set: for other programs that learn from given data."""

import contextlib
import os
import re
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vecpsmbpo.settings import SettingError

if TYPE_CHECKING:
    from vecpsmbpo.look.members import Trained

ROOT = "MINARI_DATASETS_PATH"  # where Minari keeps its data sets, an environment variable of its own


def collect(trained: "Trained", folder: Path) -> list[Any]:
    """The lane's finished episodes, as far as D_E still has them, to be written below `folder`.

    Raises:
        SettingError: there is a data set already, or no finished episode.
    """
    if (folder / _name(trained)).exists():
        raise SettingError(f"out={folder / _name(trained)}: is there already")
    buffers = list(_buffers(trained))
    if not buffers:
        raise SettingError(f"run_dir={trained.run.path}: has no finished episode to export")
    return buffers


def write(trained: "Trained", buffers: list[Any], folder: Path) -> Path:
    """Writes what `collect` found below `folder`, a root of Minari's.

    Returns:
        The data set's own directory.

    Raises:
        SettingError: it cannot be written.
    """
    import gymnasium
    import minari

    spec, run, name = trained.algorithm.spec, trained.run, _name(trained)
    spaces = {
        "observation_space": gymnasium.spaces.Box(-np.inf, np.inf, (spec.obs_size,), np.float32),
        "action_space": gymnasium.spaces.Box(-1.0, 1.0, (spec.action_size,), np.float32),
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".") as beside:
            with _root(Path(beside)), warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of authors and links that a data set could have
                minari.create_dataset_from_buffers(
                    name, buffers, **spaces, algorithm_name=f"vecpsmbpo {run.settings.algo}", description=str(run.name)
                )
            (folder / name).parent.mkdir(exist_ok=True)
            (Path(beside) / name).replace(folder / name)
    except OSError as error:
        raise SettingError(f"out={folder}: cannot be written ({error.strerror or error})") from None
    return folder / name


def _name(trained: "Trained") -> str:
    return f"vecpsmbpo/{re.sub('[^A-Za-z0-9_-]', '_', trained.run.settings.task)}-v0"


@contextlib.contextmanager
def _root(path: Path) -> Iterator[None]:
    """In it Minari keeps its data sets in `path`."""
    before = os.environ.get(ROOT)
    os.environ[ROOT] = str(path)
    try:
        yield
    finally:
        os.environ.pop(ROOT)
        if before is not None:
            os.environ[ROOT] = before


def _buffers(trained: "Trained") -> Iterator[Any]:
    """An episode each, in their order."""
    import jax.numpy as jnp
    from minari.data_collector import EpisodeBuffer

    from vecpsmbpo import replay

    run, spec = trained.run, trained.algorithm.spec
    ring = np.asarray(trained.state.real[trained.index])
    lane = run.of_lane(run.settings.lanes[trained.index])
    if not lane:
        return
    for end, length, terminated in zip(lane["env_steps"], lane["length"], lane["terminated"], strict=True):
        rows = np.arange(int(end - length), int(end))
        if end > trained.step or rows[0] < trained.step - len(ring):
            continue
        obs, action, reward, next_obs, _ = map(
            np.asarray, replay.unpack(jnp.asarray(ring[rows % len(ring)]), spec.obs_size, spec.action_size)
        )
        if len(rows) > 1 and not np.array_equal(obs[-1], next_obs[-2]):
            # The simulator diverged, and D_E holds the row before it once more.
            rows, obs, action, reward, next_obs = (x[:-1] for x in (rows, obs, action, reward, next_obs))
        last = np.arange(len(rows)) == len(rows) - 1
        yield EpisodeBuffer(
            observations=np.concatenate([obs, next_obs[-1:]]),
            actions=action,
            rewards=reward,
            terminations=last & bool(terminated),
            truncations=last & (not terminated),
        )
