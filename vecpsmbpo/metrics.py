"""What a run writes down: metrics.jsonl and episodes.jsonl, each epoch and episode exactly once; loggers are told, too.

And sessions.jsonl: a line for each time that somebody began, or went on with, the run.
"""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import numpy as np

from vecpsmbpo import jsonl, logged
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.jsonl import EPISODES_FILE, METRICS_FILE, SESSIONS_FILE, Line
from vecpsmbpo.loggers import Loggers
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import EpisodeEnd, TrainState

ALWAYS = tuple(name for name, quantity in logged.QUANTITIES.items() if quantity.always)
read = jsonl.read


class RunLog:
    """The log files of one run directory."""

    def __init__(
        self,
        run_dir: Path,
        env_steps: int,
        settings: Settings,
        warn: Callable[[str], None],
        marks: Mapping[str, Any] = MappingProxyType({}),
        *,
        unevaluated: bool = False,
    ):
        """Lines beyond `env_steps` belong to work that a kill undid and that will be done again: they are dropped.

        Args:
            warn: is told what goes wrong with a logger, and what was found wrong in a file.
            marks: what `marks` was at `env_steps`.
            unevaluated: whether the epoch that ended there had not been evaluated: its lines will be written again.
        """
        self._run_dir, self._lane = run_dir, tuple(settings.lanes[0])
        needed = (jsonl.STEP, *self._lane)
        self._files = {
            name: jsonl.Growing(run_dir / name, env_steps, needed, marks.get(name), warn, unfinished=unevaluated)
            for name in (METRICS_FILE, EPISODES_FILE)
        }
        written = max(file.written for file in self._files.values())
        self._sessions = jsonl.Growing(run_dir / SESSIONS_FILE, jsonl.LARGEST_STEP, (jsonl.STEP,), None, warn)
        self._loggers = Loggers(settings, run_dir, env_steps, written, warn)

    @property
    def marks(self) -> dict[str, list[int]]:
        """By name of the file, what its lines are known by: for a checkpoint."""
        return {name: list(file.mark) for name, file in self._files.items()}

    def session(self, line: Line) -> None:
        """Writes down that a session began, and what with."""
        self._sessions.append([line])

    def episodes(self, lines: Iterable[Line]) -> None:
        """Writes finished episodes."""
        lines = list(lines)
        self._files[EPISODES_FILE].append(lines)
        for line in lines:
            self._scalars(line, ("return", "length"), "episode")

    def metrics(self, lines: Iterable[Line]) -> None:
        """Writes an epoch."""
        lines = list(lines)
        self._files[METRICS_FILE].append(lines)
        for line in lines:
            self._scalars(line, set(line) - {"env_steps", "seed"}, "epoch")
        self._loggers.flush()

    def _scalars(self, line: Line, names: Iterable[str], group: str) -> None:
        which = "_".join(f"{name}{line[name]}" for name in self._lane)
        numbers = {name: line[name] for name in names if isinstance(line[name], int | float)}
        self._loggers.scalars({f"{group}/{name}/{which}": value for name, value in numbers.items()}, line["env_steps"])

    def close(self) -> None:
        self._loggers.close()


class NoLog:
    """Of a process that does not write: as `RunLog`."""

    marks: Mapping[str, Any] = MappingProxyType({})

    def session(self, line: Line) -> None: ...

    def episodes(self, lines: Iterable[Line]) -> None: ...

    def metrics(self, lines: Iterable[Line]) -> None: ...

    def close(self) -> None: ...


def episode_lines(news: EpisodeEnd, env_steps: int, settings: Settings) -> list[Line]:
    """The episodes that finished in a chunk.

    Args:
        news: leaves [T, S, ...].
        env_steps: before the chunk.
    """
    lines = []
    for step, seed in zip(*np.nonzero(news.done), strict=True):
        here = [np.asarray(leaf)[step, seed] for leaf in (news.index, news.member, news.episode_return, news.length)]
        index, member, episode_return, length = here
        terminated = bool(news.terminated[step, seed])
        lines.append(
            {
                **lane_of(settings, seed),
                "episode": int(index),
                "env_steps": env_steps + int(step) + 1,
                "model": None if member < 0 else int(member) // settings.policies_per_model,
                "policy": None if member < 0 else int(member) % settings.policies_per_model,
                "return": float(episode_return),
                "length": int(length),
                "terminated": terminated,
                "truncated": not terminated,
                "random": bool(news.random[step, seed]),
                "probs": news.probs[step, seed].reshape(-1, settings.policies_per_model).tolist(),
            }
        )
        if news.values is not None:
            lines[-1]["values"] = news.values[step, seed].reshape(-1, settings.policies_per_model).tolist()
    return lines


def epoch_lines(state: TrainState, algorithm: Algorithm) -> list[Line]:
    """What the train state says of the epoch that has just ended, one line per seed (and swept value).

    Null: there was nothing yet.

    Args:
        state: without padding (`placement.unpad`); its rings are not looked at.
    """
    settings, seeds = algorithm.settings, state.seeds
    stats = {name: np.asarray(value) for name, value in vars(seeds.agents.stats).items()}
    updates = stats.pop("updates")
    fitted = np.asarray(seeds.models.optimizer.count)[:, 0] > 0
    rest = seeds.replace(key=None, models=None, agents=None, real=None, imagined=None)
    rest = jax.tree.map(np.asarray, rest)  # of which a lane's part is a view
    lines = []
    for seed in range(len(settings.lanes)):
        episodes = float(seeds.epoch_episodes[seed])
        models = {
            "model_loss": seeds.models.loss[seed, : settings.n_models],
            "model_val_mse": seeds.models.val_mse[seed, : settings.n_models],
        }
        agents = {name: value[seed] / np.maximum(updates[seed], 1) for name, value in stats.items()}
        learned = updates[seed, 0] > 0
        own = algorithm.numbers(state.counters, jax.tree.map(lambda x, seed=seed: x[seed], rest))
        lines.append(
            {
                "env_steps": int(state.counters.env_steps),
                **lane_of(settings, seed),
                "train_return": float(seeds.epoch_return[seed]) / episodes if episodes else None,
                "train_episodes": int(episodes),
                "unsound_steps": int(seeds.epoch_unsound[seed]),
                **{name: float(np.mean(value)) if fitted[seed] else None for name, value in models.items()},
                **dict.fromkeys(ALWAYS),
                **{name: float(np.mean(value)) if learned else None for name, value in agents.items()},
                **{name: _plain(value) for name, value in own.items()},
            }
        )
    return lines


def lane_of(settings: Settings, index: int) -> Line:
    """The seed and the swept values of a lane, by name."""
    return {name: _number(value) for name, value in settings.lanes[index].items()}


def _plain(value: Any) -> Any:
    """A number, or a list of them, in JSON's types."""
    return np.asarray(value).tolist() if np.ndim(value) else _number(value)


def _number(value: Any) -> int | float | str:
    """A number as it was set: 0.2 and not float32's 0.20000000298; "inf" for infinity, which JSON does not have."""
    if isinstance(value, int):
        return value
    return float(str(np.float32(value))) if np.isfinite(value) else "inf"
