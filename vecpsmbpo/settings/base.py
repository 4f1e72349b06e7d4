"""The settings of every run, whatever learns."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any

from vecpsmbpo.settings.fields import choice, real, whole

Options = tuple[tuple[str, Any], ...]  # name and value of each `env.*` option, in the order of names
Sweep = tuple[tuple[str, tuple[float, ...]], ...]  # name and values of each `sweep.*`, in the order of names

# Settings that a resumed run may change: they steer the loop around the run, not what it computes.
CHANGEABLE = frozenset(
    {"total_steps", "eval_episodes", "eval_policy", "eval_actions", "checkpoint_every", "report", "devices"}
    | {"distributed", "keep_checkpoints", "loggers", "compile_cache"}
)

# Above any use, and what building or compiling them would never end with.
MOST_LANES = 10_000
MOST_EPISODES = 10_000  # of an evaluation, an environment each
MOST_LAYERS = 100
MOST_ROWS = 10_000_000  # of a minibatch, or start states


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """One run, resolved. Hashable: shapes and loop lengths are read from here when a program is traced."""

    # what runs
    env: str
    env_options: Options = ()
    algo: str
    size: str
    recipe: str
    backend: str = choice("auto", "mjx", "host")
    seed: int = whole(0)
    num_seeds: int = whole(1)
    sweep: Sweep = ()
    total_steps: int = whole(1)
    run_dir: str
    # the loop around it
    epoch_steps: int = whole(1)
    episode_length: int = whole(0)
    train_episode_length: int = whole(0)
    eval_episodes: int = whole(1, MOST_EPISODES)
    checkpoint_every: int = whole(1)
    keep_checkpoints: int = whole(1)
    report: bool
    loggers: tuple[str, ...] = choice("tensorboard", "wandb", "mlflow")
    devices: int = whole(0)
    distributed: str
    compile_cache: bool
    network_precision: str = choice("default", "float32", "bfloat16")
    # real data
    warmup_steps: int = whole(1)
    random_hold: int = whole(1)
    replay_capacity: int = whole(1)
    # dynamics models (A.1)
    n_models: int = whole(1)
    model_hidden_size: int = whole(1)
    model_hidden_layers: int = whole(1, MOST_LAYERS)
    model_learning_rate: float = real(0, open_low=True, traced=True)
    model_weight_decay: float = real(0, traced=True)
    model_batch_size: int = whole(1, MOST_ROWS)
    model_update_every: int = whole(1)
    whiten_targets: bool
    prior_scale: float = real(0, traced=True)
    # who acts
    forced_exploration: float = real(0, traced=True)

    @property
    def task(self) -> str:
        """The task in words: `hopper`, `dm_control finger spin`."""
        return " ".join([self.env, *(str(value) for _, value in self.env_options)])

    @property
    def summary(self) -> str:
        """How much learns, in words."""
        return f"N = {self.n_models} model(s)"

    @property
    def training_limit(self) -> int:
        """Control steps after which an episode that is learned from is truncated."""
        return self.train_episode_length or self.episode_length

    @property
    def policies_per_model(self) -> int:
        """M, 1 where policies are not counted."""
        return 1

    @property
    def n_members(self) -> int:
        """How many there are of whom one acts."""
        return 1

    @property
    def minibatch(self) -> int:
        """Rows of the minibatches at every step, which devices may divide among them; 1 where there are none."""
        return 1

    @property
    def weighs_values(self) -> bool:
        """Whether members are drawn by what their critics promise, and not by what they have earned."""
        return False

    @property
    def plans_actions(self) -> bool:
        """Whether actions are planned in the models; there is no policy then."""
        return False

    @property
    def learns_by_sac(self) -> bool:
        """Whether every member is an agent of `sac`, whose actor and critics can be asked by themselves."""
        return False

    @property
    def averages_members(self) -> bool:
        """Whether all members act together, and none is drawn."""
        return False

    @functools.cached_property
    def lanes(self) -> tuple[dict[str, Any], ...]:
        """The S learners of the program: every seed with every combination of swept values, as log lines name them."""
        seeds = [{"seed": self.seed + index} for index in range(self.num_seeds)]
        names = [name for name, _ in self.sweep]
        points = itertools.product(*(values for _, values in self.sweep))
        return tuple({**seed, **dict(zip(names, point, strict=True))} for point in points for seed in seeds)

    @property
    def has_prior(self) -> bool:
        """Whether models have a random function prior."""
        return self.prior_scale > 0 or "prior_scale" in dict(self.sweep)

    @property
    def refreshes_per_epoch(self) -> int:
        return self.epoch_steps // self.model_update_every

    @property
    def stride(self) -> int:
        """Steps after which the host may look at the run, and stop it: the largest divisor of a period up to 25."""
        return max(steps for steps in range(1, 26) if self.model_update_every % steps == 0)

    @property
    def first_learning_step(self) -> int:
        """The first multiple of a period at which the warm-up is over."""
        return -(-self.warmup_steps // self.model_update_every) * self.model_update_every

    def may_change(self, name: str) -> bool:
        """Whether a resumed run may be given another value of the setting `name`."""
        return name in CHANGEABLE

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        """Whether settings contradict one another, and how to say so; a subclass adds its own."""
        yield (
            self.epoch_steps % self.model_update_every != 0,
            f"model_update_every={self.model_update_every}: must divide epoch_steps={self.epoch_steps}",
        )
        yield (
            self.total_steps % self.epoch_steps != 0,
            f"total_steps={self.total_steps}: must be a multiple of epoch_steps={self.epoch_steps}",
        )
        yield (
            self.seed + self.num_seeds > 2**31,
            f"num_seeds={self.num_seeds}: the last seed, seed + num_seeds - 1, must be at most {2**31 - 1}",
        )
        lanes = self.num_seeds * math.prod(len(values) for _, values in self.sweep)
        yield (
            lanes > MOST_LANES,
            f"num_seeds={self.num_seeds}: at most {MOST_LANES} seeds, each swept value counted, not {lanes}",
        )
        yield (
            lanes * self.eval_episodes > MOST_EPISODES,
            f"eval_episodes={self.eval_episodes}: at most {MOST_EPISODES} of all seeds together, not "
            f"{lanes * self.eval_episodes}",
        )
        yield (
            self.replay_capacity < self.warmup_steps,
            f"replay_capacity={self.replay_capacity}: must be at least warmup_steps",
        )
