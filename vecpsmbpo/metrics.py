"""What a train state, and the news of a chunk, say in the lines of metrics.jsonl and episodes.jsonl (`run_log`)."""

from typing import Any

import jax
import numpy as np

from vecpsmbpo import logged
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.jsonl import Line
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import EpisodeEnd, TrainState

ALWAYS = tuple(name for name, quantity in logged.QUANTITIES.items() if quantity.always)


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
    of_models = {"model_loss": seeds.models.loss}
    if seeds.models.val_mse is not None:
        of_models["model_val_mse"] = seeds.models.val_mse
    rest = seeds.replace(key=None, models=None, agents=None, real=None, imagined=None)
    rest = jax.tree.map(np.asarray, rest)  # of which a lane's part is a view
    lines = []
    for seed in range(len(settings.lanes)):
        episodes = float(seeds.epoch_episodes[seed])
        models = {name: value[seed, : settings.n_models] for name, value in of_models.items()}
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
                **dict.fromkeys(ALWAYS),
                **{name: float(np.mean(value)) if fitted[seed] else None for name, value in models.items()},
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
