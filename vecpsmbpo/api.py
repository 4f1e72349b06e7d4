"""The package as a library: what `vecpsmbpo.train` and `vecpsmbpo.load` give."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vecpsmbpo import config, dynamics, jsonl
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.evaluate import evaluate
from vecpsmbpo.look import exported, members, runs
from vecpsmbpo.settings import SettingError, Settings
from vecpsmbpo.training import train as run_training
from vecpsmbpo.types import Model

# Columns of the logs that are not plain numbers, which is what `runs` reads all of them as.
_OF_EPOCHS = "train_episodes", "unsound_steps", "eval_broken_off"
WHOLE = ("env_steps", "seed", "episode", "length", "model", "policy", *_OF_EPOCHS)
TRUTHS = ("terminated", "truncated", "random", "frozen")

Array = np.ndarray
Table = Any  # a pandas.DataFrame, or where pandas is not installed a dictionary of columns [L, ...]


class Prediction(NamedTuple):
    """What a dynamics model expects to follow, in the task's units.

    Attributes:
        next_obs, next_obs_std: [..., O] mean of s' and its standard deviation (equation 21).
        reward, reward_std: [...].
        terminated: [...] bool, by the task's own rule at the mean; where the models learn that, its probability.
    """

    next_obs: jax.Array
    reward: jax.Array
    next_obs_std: jax.Array
    reward_std: jax.Array
    terminated: jax.Array


class DynamicsModel:
    """One of the N models of a lane: model(obs [..., O], action [..., A]) -> Prediction. Actions lie in [-1, 1]."""

    def __init__(self, model: Model, algorithm: Algorithm):
        net, spec = algorithm.model_net, algorithm.spec

        def predict(obs: jax.Array, action: jax.Array) -> Prediction:
            mean, log_variance, logit = dynamics.forward(model, obs, action, net=net)
            std = jnp.exp(0.5 * log_variance)
            next_obs = obs + mean[..., :-1]
            terminated = jax.nn.sigmoid(logit) if spec.terminated is None else spec.terminated(obs, action, next_obs)
            return Prediction(next_obs, mean[..., -1], std[..., :-1], std[..., -1], terminated)

        self._predict = jax.jit(predict)

    def __call__(self, obs: Any, action: Any) -> Prediction:
        return self._predict(jnp.asarray(obs, jnp.float32), jnp.asarray(action, jnp.float32))


class Run:
    """A run directory: its logs, and what its newest checkpoint holds of one lane.

    Logs are read whenever they are asked for; `policy` and `models` stay what they were when first asked for.

    Attributes:
        run_dir: where it lies.
        settings: that it was started with.
        lane: which seed (or seed with a swept value) `policy` and `models` belong to: an index of `settings.lanes`.
    """

    run_dir: Path
    settings: Settings
    lane: int

    def __init__(self, run_dir: str | Path, lane: int = 0):
        """
        Raises:
            SettingError: there is no run, or no such lane.
        """
        self.run_dir, self.lane = Path(run_dir), lane
        found = runs.load(self.run_dir)
        runs.check_lane(found, lane)
        self.settings = found.settings

    def __repr__(self) -> str:
        one = self.settings
        return f"<Run {self.run_dir}: {one.task}, {one.algo}, {self.env_steps} of {one.total_steps} steps>"

    # ── logs ─────────────────────────────────────────────────────────────────────────────────────────────────────

    @property
    def metrics(self) -> Table:
        """A row per epoch and lane: metrics.jsonl as it is now."""
        return _table(runs.read(self.run_dir / jsonl.METRICS_FILE).columns)

    @property
    def episodes(self) -> Table:
        """A row per finished real episode: episodes.jsonl as it is now. `probs` are the N·M members' in a row."""
        return _table(runs.read(self.run_dir / jsonl.EPISODES_FILE).columns)

    @property
    def env_steps(self) -> int:
        """Up to which epoch there are metrics."""
        return runs.load(self.run_dir).env_steps

    @property
    def complete(self) -> bool:
        """Whether it came to its end; if not, `vecpsmbpo.train(run_dir=...)` goes on with it."""
        return runs.load(self.run_dir).complete

    # ── the newest checkpoint ────────────────────────────────────────────────────────────────────────────────────

    @property
    def _trained(self) -> members.Trained:
        # Loaded anew each time and not kept: it holds all rings, of which neither a policy nor a model needs any.
        return members.load(runs.load(self.run_dir), self.lane)

    @cached_property
    def policy(self) -> members.Act:
        """obs [..., O] -> mean action [..., A] in [-1, 1], jitted: of the best member (`posterior.best`); with
        `posterior=average` the mean of all members' actions.

        Raises:
            SettingError: there is no checkpoint, or the algorithm has no policy (PETS).
        """
        act = members.acting(self._trained, "best")[0][1]
        return lambda obs: act(jnp.asarray(obs, jnp.float32))

    @cached_property
    def models(self) -> list[DynamicsModel]:
        """The N dynamics models.

        Raises:
            SettingError: there is no checkpoint, or no model has been fitted yet (`algo=sac` has none).
        """
        trained = self._trained
        models = trained.models()
        if models is None:
            raise SettingError(f"run_dir={self.run_dir}: no model has been fitted yet")
        one = [jax.tree.map(lambda x, n=n: x[n], models) for n in range(self.settings.n_models)]
        return [DynamicsModel(model, trained.algorithm) for model in one]

    def evaluate(self, **how: Any) -> Table:
        """Whole episodes of all lanes in environments of their own: a row per episode.

        Args:
            how: as the words of `vecpsmbpo eval`: episodes, policy, actions, backend, devices.

        Raises:
            SettingError: a mistake in them, or there is no checkpoint.
        """
        _, returns = evaluate(self.settings, config.for_evaluation(self.settings, how))
        lanes, (count, episodes) = self.settings.lanes, returns.episode_return.shape
        columns = {name: np.repeat([lane[name] for lane in lanes], episodes) for name in lanes[0]}
        columns["episode"] = np.tile(np.arange(episodes), count)
        found = {
            "return": returns.episode_return,
            "length": returns.length,
            "broken_off": returns.broken_off,
        }
        return _table(columns | {name: values.ravel() for name, values in found.items()})


class Policy:
    """A directory that `vecpsmbpo export` has written: a policy by itself.

    Attributes:
        path: where it lies.
        settings: of the run that it comes from.
        about: task, run, algo, env_steps, seed, member and sizes, by name.
    """

    def __init__(self, path: str | Path):
        """
        Raises:
            SettingError: its files cannot be read.
        """
        self._exported = exported.load(path)
        self.path, self.settings, self.about = self._exported.path, self._exported.settings, self._exported.about

    def __repr__(self) -> str:
        return f"<Policy {self.path}: {self.settings.task}, {self.settings.algo}, {self.about.get('env_steps')} steps>"

    def policy(self, obs: Any) -> Array:
        """obs [..., O] -> mean action [..., A] in [-1, 1]."""
        return self._exported.network(obs)

    def evaluate(self, seed: int = 0, **how: Any) -> Table:
        """Whole episodes: a row per episode.

        Args:
            seed: of the environments.
            how: as the words of `vecpsmbpo eval`: episodes, backend.

        Raises:
            SettingError: a mistake in them, or the task's suite is not installed.
        """
        settings = exported.for_evaluation(self._exported, how)
        returns, lengths = exported.evaluate(self._exported, settings, seed)
        return _table({"episode": np.arange(len(returns)), "return": returns, "length": lengths})


def load(path: str | Path, lane: int = 0) -> Run | Policy:
    """As `vecpsmbpo.load`."""
    if not exported.is_one(path):
        return Run(path, lane)
    if lane:
        raise SettingError(f"lane={lane}: {path} is one policy, without lanes")
    return Policy(path)


def train(**settings: Any) -> Run:
    """As `vecpsmbpo.train`."""
    if settings.get("distributed"):
        raise SettingError("distributed: is for the command line, which a run of several processes has to itself")
    resolved = config.resolve(config.overrides_of(settings))
    run_training(resolved)
    return Run(resolved.run_dir)


def _table(columns: Mapping[str, Array]) -> Table:
    columns = {name: _typed(name, column) for name, column in columns.items()}
    try:
        import pandas
    except ImportError:
        return columns
    return pandas.DataFrame({name: column if column.ndim == 1 else list(column) for name, column in columns.items()})


def _typed(name: str, column: Array) -> Array:
    if name in WHOLE and np.isfinite(column).all():
        return column.astype(int)
    return np.nan_to_num(column).astype(bool) if name in TRUTHS else column
