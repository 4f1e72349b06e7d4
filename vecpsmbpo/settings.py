"""Every setting of a run, with its type and range. Knows nothing of Hydra or JAX, so mistakes answer at once.

What each setting does is written beside its value in `configs/`; where a number comes from, too.
"""

import dataclasses
import functools
import itertools
import math
import struct
from collections.abc import Iterator, Mapping
from typing import Any

Range = tuple[float | None, float | None]
Options = tuple[tuple[str, Any], ...]  # name and value of each `env.*` option, in the order of names
Sweep = tuple[tuple[str, tuple[float, ...]], ...]  # name and values of each `sweep.*`, in the order of names

# What the program's int32 and float32 hold; smaller numbers are taken for 0.
LARGEST_WHOLE = 2**31 - 1
LARGEST, SMALLEST = 3.4e38, 1.2e-38
MOST_LANES = 10_000


class SettingError(Exception):
    """A mistake in a setting: one line that names the setting and what it may be."""


def _whole(at_least: int, at_most: int = LARGEST_WHOLE) -> Any:
    return dataclasses.field(metadata={"range": (at_least, at_most)})


def _real(at_least: float | None = None, at_most: float | None = None, *, open_low: bool = False) -> Any:
    return dataclasses.field(metadata={"range": (at_least, at_most), "open_low": open_low})


def _choice(*names: str) -> Any:
    return dataclasses.field(metadata={"choices": names})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """One run, resolved. Hashable: shapes and loop lengths are read from here when a program is traced."""

    # what runs
    env: str
    env_options: Options = ()
    algo: str
    size: str
    recipe: str
    backend: str = _choice("auto", "mjx", "host")
    seed: int = _whole(0)
    num_seeds: int = _whole(1)
    sweep: Sweep = ()
    total_steps: int = _whole(1)
    run_dir: str
    # the loop around it
    epoch_steps: int = _whole(1)
    episode_length: int = _whole(0)
    eval_episodes: int = _whole(1)
    eval_policy: str = _choice("posterior", "best", "average")
    eval_actions: str = _choice("mean", "sampled")
    checkpoint_every: int = _whole(1)
    keep_checkpoints: int = _whole(1)
    report: bool
    loggers: tuple[str, ...] = _choice("tensorboard", "wandb", "mlflow")
    devices: int = _whole(0)
    compile_cache: bool
    # real data
    warmup_steps: int = _whole(1)
    replay_capacity: int = _whole(1)
    # dynamics models (A.1)
    n_models: int = _whole(1)
    model_hidden_size: int = _whole(1)
    model_hidden_layers: int = _whole(1)
    model_learning_rate: float = _real(0, open_low=True)
    model_weight_decay: float = _real(0)
    model_batch_size: int = _whole(1)
    model_update_every: int = _whole(1)
    model_patience: int = _whole(1)
    model_improvement: float = _real(0, 1)
    model_max_epochs: int = _whole(1)
    validation_ratio: float = _real(0, 0.5, open_low=True)
    whiten_targets: bool
    prior_scale: float = _real(0)
    # imagined data
    rollout_starts: int = _whole(1)
    imagined_capacity: int = _whole(1)
    horizon_first: int = _whole(1)
    horizon_last: int = _whole(1)
    horizon_ramp_start: float = _real(0)
    horizon_ramp_end: float = _real(0)
    rollout_models: str = _choice("own", "any")
    # policies (A.2)
    n_policies: int = _whole(1)
    policy_hidden_size: int = _whole(1)
    policy_hidden_layers: int = _whole(1)
    policy_learning_rate: float = _real(0, open_low=True)
    policy_batch_size: int = _whole(1)
    updates_per_step: int = _whole(1)
    discount: float = _real(0, 1)
    target_entropy: float = _real()
    target_update_rate: float = _real(0, 1, open_low=True)
    target_update_every: int = _whole(1)
    critic_norm: str = _choice("none", "layer", "rms")
    clip_targets: bool
    bound_log_prob: bool
    # model and policy in turns (SLBO)
    rounds: int = _whole(1)
    model_steps: int = _whole(1)
    model_steps_ahead: int = _whole(1)
    policy_steps: int = _whole(1)
    policy_rollouts: int = _whole(1)
    policy_rollout_length: int = _whole(1)
    trust_region: float = _real(0, open_low=True)
    gae_decay: float = _real(0, 1)
    entropy_weight: float = _real(0)
    # plans (PETS)
    plan_horizon: int = _whole(1)
    plan_hold: int = _whole(1)
    plan_population: int = _whole(2)
    plan_elites: int = _whole(1)
    plan_iterations: int = _whole(1)
    plan_particles: int = _whole(1)
    # the posterior over policies
    real_ratio: float = _real(0, 1)
    real_ratio_schedule: str = _choice("constant", "linear", "bandit")
    real_ratio_arms: tuple[float, ...] = _real(0, 1)
    temperature: float = _real(0, open_low=True)
    weights: str = _choice("returns", "values")
    posterior: str = _choice("sample", "average")
    forced_exploration: float = _real(0)

    @property
    def task(self) -> str:
        """The task in words: `hopper`, `dm_control finger spin`."""
        return " ".join([self.env, *(str(value) for _, value in self.env_options)])

    @property
    def n_members(self) -> int:
        """The policies that the posterior draws from: N·M, or M where none belongs to a model."""
        return self.n_policies * (self.n_models if self.rollout_models == "own" and not self.plans else 1)

    @property
    def alternates(self) -> bool:
        """Whether one model and one policy learn in turns, at refreshes only."""
        return self.algo == "slbo"

    @property
    def plans(self) -> bool:
        """Whether actions are planned in the models, and no policy is learned."""
        return self.algo == "pets"

    @property
    def only_real(self) -> bool:
        """Whether nothing is ever imagined: `algo=sac`."""
        return self.algo == "sac"

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
    def adapts_real_ratio(self) -> bool:
        """Whether λ is chosen online."""
        return self.real_ratio_schedule == "bandit"

    @property
    def weighs_values(self) -> bool:
        """Whether members are drawn by what their critics promise, and not by what they have earned."""
        return self.weights == "values"

    @property
    def imagines(self) -> bool:
        """Whether any lane ever learns from imagined data (λ < 1)."""
        ratios = dict(self.sweep).get("real_ratio", (self.real_ratio,))
        if self.adapts_real_ratio:
            ratios = self.real_ratio_arms
        return self.real_ratio_schedule == "linear" or min(ratios) < 1

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

    @property
    def validation_block(self) -> int:
        """k, when one row in k validates: the split draws one row of every k consecutive ones."""
        return round(1 / self.validation_ratio)


# The settings that a command line names; the options of a task are `env.*` there, and what is swept is `sweep.*`.
FIELDS = {field.name: field for field in dataclasses.fields(Settings) if field.name not in ("env_options", "sweep")}

# Settings that are numbers inside the compiled program (`types.Hyper`): several values fit into one program.
TRACED = (
    "model_learning_rate",
    "model_weight_decay",
    "policy_learning_rate",
    "discount",
    "target_entropy",
    "target_update_rate",
    "real_ratio",
    "temperature",
    "forced_exploration",
    "prior_scale",
)

# Settings that a resumed run may change: they steer the loop around the run, not what it computes.
CHANGEABLE = frozenset(
    {"total_steps", "eval_episodes", "eval_policy", "eval_actions", "checkpoint_every", "report", "devices"}
    | {"keep_checkpoints", "loggers", "compile_cache"}
)


def allowed(name: str) -> str:
    """What the setting `name` may be, in words."""
    field = FIELDS[name]
    if choices := field.metadata.get("choices"):
        return ("a list of " if field.type == tuple[str, ...] else "one of ") + ", ".join(choices)
    kinds: dict[Any, str] = {int: "a whole number", float: "a number", bool: "true or false", str: "a name"}
    kinds[tuple[float, ...]] = "a list of numbers, each"
    kind = kinds[field.type]
    low, high = field.metadata.get("range", (None, None))
    above = "above" if field.metadata.get("open_low") else "at least"
    if low is not None and high not in (None, LARGEST_WHOLE):
        return f"{kind} from {low} to {high}" if above == "at least" else f"{kind} above {low} and at most {high}"
    return kind if low is None else f"{kind}, {above} {low}"


def check(name: str, value: Any) -> Any:
    """`value` as the type of the setting `name`.

    Raises:
        SettingError: the value has the wrong type or lies out of range.
    """
    field = FIELDS[name]
    complaint = SettingError(f"{name}={value}: must be {allowed(name)}")
    if field.type is bool:
        if not isinstance(value, bool):
            raise complaint
        return value
    if field.type is str:
        if not isinstance(value, str) or value not in field.metadata.get("choices", (value,)):
            raise complaint
        return value
    if field.type == tuple[str, ...]:
        if not isinstance(value, list | tuple) or any(item not in field.metadata["choices"] for item in value):
            raise complaint
        return tuple(dict.fromkeys(value))
    if field.type == tuple[float, ...]:
        if not isinstance(value, list | tuple) or not value:
            raise complaint
        return tuple(_number(field, item, complaint) for item in value)
    return _number(field, value, complaint)


def _number(field: Any, value: Any, complaint: SettingError) -> Any:
    """`value`, or the item of a list, as a number in the field's range."""
    try:
        number = math.inf if value == ".inf" else float(value)  # as YAML spells it
    except (TypeError, ValueError):
        raise complaint from None
    if isinstance(value, bool) or math.isnan(number):
        raise complaint
    if field.type is int:
        if not math.isfinite(number) or number != int(number):
            raise complaint
        number = int(number)
    elif math.isinf(number) and field.name != "temperature":  # τ = ∞ is uniform sampling, equation 18
        raise complaint
    low, high = field.metadata.get("range", (None, None))
    too_low = low is not None and (number < low or (number == low and field.metadata.get("open_low", False)))
    if field.type is int and number > LARGEST_WHOLE:
        raise SettingError(f"{field.name}={value}: must be at most {LARGEST_WHOLE}")
    if too_low or (high is not None and number > high):
        raise complaint
    if field.type is not int and number and not SMALLEST <= abs(number) <= LARGEST and math.isfinite(number):
        raise SettingError(f"{field.name}={value}: must be 0 or between {SMALLEST} and {LARGEST} in size")
    return number


def check_sweep(name: str, values: Any) -> tuple[float, ...]:
    """The values of `sweep.<name>=[...]`.

    Raises:
        SettingError: the setting cannot be swept inside one program, or a value is wrong.
    """
    if name not in TRACED:
        raise SettingError(f"sweep.{name}: cannot be swept in one program (-m can); one of {', '.join(TRACED)}")
    if not isinstance(values, list | tuple) or not values:
        raise SettingError(f"sweep.{name}={values}: must be a list of values, each {allowed(name)}")
    checked = tuple(check(name, value) for value in values)
    if len({struct.pack("f", value) for value in checked}) < len(checked):
        raise SettingError(f"sweep.{name}={list(values)}: two of its values are the same in float32")
    return checked


def build(values: Mapping[str, Any]) -> Settings:
    """Settings from plain values, each checked, and checked against one another.

    Raises:
        SettingError: a value is wrong, or two contradict.
    """
    options = tuple(sorted(dict(values.get("env_options", ())).items()))
    for name, value in options:
        if not isinstance(value, str) or not value:
            raise SettingError(f"env.{name}={value}: must be a name")
    sweep = tuple((name, check_sweep(name, swept)) for name, swept in sorted(dict(values.get("sweep", ())).items()))
    checked = {name: check(name, values[name]) for name in FIELDS}
    settings = Settings(env_options=options, sweep=sweep, **checked)
    for wrong, complaint in _contradictions(settings):
        if wrong:
            raise SettingError(complaint)
    return settings


def _contradictions(one: Settings) -> Iterator[tuple[bool, str]]:
    """Whether settings contradict one another, and how to say so."""
    yield (
        one.epoch_steps % one.model_update_every != 0,
        f"model_update_every={one.model_update_every}: must divide epoch_steps={one.epoch_steps}",
    )
    yield (
        one.total_steps % one.epoch_steps != 0,
        f"total_steps={one.total_steps}: must be a multiple of epoch_steps={one.epoch_steps}",
    )
    yield (
        one.seed + one.num_seeds > 2**31,
        f"num_seeds={one.num_seeds}: the last seed, seed + num_seeds - 1, must be at most {2**31 - 1}",
    )
    lanes = one.num_seeds * math.prod(len(values) for _, values in one.sweep)
    yield (
        lanes > MOST_LANES,
        f"num_seeds={one.num_seeds}: at most {MOST_LANES} seeds, each swept value counted, not {lanes}",
    )
    yield one.horizon_ramp_end <= one.horizon_ramp_start, "horizon_ramp_end: must be greater than horizon_ramp_start"
    yield (
        not math.isclose(one.validation_block * one.validation_ratio, 1, rel_tol=1e-2),
        f"validation_ratio={one.validation_ratio}: must be 1 / k for a whole number k, as one row in k validates",
    )
    yield (
        one.warmup_steps < one.validation_block,
        f"warmup_steps={one.warmup_steps}: must be at least 1 / validation_ratio = {one.validation_block}",
    )
    yield (
        one.replay_capacity < one.warmup_steps,
        f"replay_capacity={one.replay_capacity}: must be at least warmup_steps",
    )
    moves = one.real_ratio_schedule != "constant"
    swept = dict(one.sweep)
    yield moves and "real_ratio" in swept, "sweep.real_ratio: needs real_ratio_schedule=constant"
    # What an algorithm does not have.
    name, rolls_out = f"algo={one.algo}", not (one.only_real or one.alternates or one.plans)
    longest = max(one.horizon_first, one.horizon_last)
    yield (
        rolls_out and one.imagined_capacity < longest,
        f"imagined_capacity={one.imagined_capacity}: must hold a rollout, of up to {longest} steps",
    )
    yield (one.only_real or one.alternates) and one.n_models != 1, f"n_models={one.n_models}: must be 1 with {name}"
    yield not rolls_out and one.n_policies != 1, f"n_policies={one.n_policies}: must be 1 with {name}"
    ratio = 1.0 if one.only_real else 0.0
    yield (
        not rolls_out and (moves or "real_ratio" in swept or one.real_ratio != ratio),
        f"real_ratio: must be {ratio:g} with {name}, and stay there",
    )
    yield (
        (one.alternates or one.plans) and one.posterior == "average",
        f"posterior=average: there are no policies to average with {name}",
    )
    arms = ", ".join(f"{arm:g}" for arm in one.real_ratio_arms)
    yield list(one.real_ratio_arms) != sorted(set(one.real_ratio_arms)), f"real_ratio_arms=[{arms}]: must rise"
    yield (
        one.adapts_real_ratio and one.posterior == "average",
        "posterior=average: no policy earns what real_ratio_schedule=bandit would choose by",
    )
    yield (
        (one.alternates or one.plans) and one.weighs_values,
        f"weights=values: there are no critics with {name}",
    )
    yield one.plan_elites > one.plan_population, f"plan_elites={one.plan_elites}: must be at most plan_population"
    yield (
        one.plans and one.plan_particles % one.n_models != 0,
        f"plan_particles={one.plan_particles}: must be a multiple of n_models={one.n_models}",
    )
