"""Groups of settings that the mathematics is typed by (`sac`, `imagination`, `mixing`), which knows no algorithm: an
algorithm's own class puts together those that it has."""

import dataclasses
import math
from collections.abc import Iterator

from vecpsmbpo.settings.base import MOST_LAYERS, MOST_ROWS, Settings
from vecpsmbpo.settings.fields import choice, real, whole


@dataclasses.dataclass(frozen=True, kw_only=True)
class FitSettings(Settings):
    """Of `dynamics.fit`, which ends where validation data say so (A.1)."""

    model_patience: int = whole(1)
    model_improvement: float = real(0, 1)
    model_max_epochs: int = whole(1)
    validation_ratio: float = real(0, 0.5, open_low=True)
    nll_beta: float = real(0, 1)
    reward_nll_beta: float = real(0, 1)

    @property
    def validation_block(self) -> int:
        """k, when one row in k validates: the split draws one row of every k consecutive ones."""
        return round(1 / self.validation_ratio)

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        yield from super().contradictions()
        yield (
            not math.isclose(self.validation_block * self.validation_ratio, 1, rel_tol=1e-2),
            f"validation_ratio={self.validation_ratio}: must be 1 / k for a whole number k, as one row in k validates",
        )
        yield (
            self.warmup_steps < self.validation_block,
            f"warmup_steps={self.warmup_steps}: must be at least 1 / validation_ratio = {self.validation_block}",
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicySettings(Settings):
    """Of learned policies."""

    eval_actions: str = choice("mean", "sampled")
    policy_hidden_size: int = whole(1)
    policy_hidden_layers: int = whole(1, MOST_LAYERS)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SacSettings(PolicySettings):
    """Of `sac` (A.2)."""

    policy_learning_rate: float = real(0, open_low=True, traced=True)
    policy_learning_rate_cooldown: float = real(0, 1)
    policy_batch_size: int = whole(1, MOST_ROWS)
    updates_per_step: int = whole(1)
    discount: float = real(0, 1, traced=True)
    target_entropy: float = real(traced=True)
    target_update_rate: float = real(0, 1, open_low=True, traced=True)
    critic_norm: str = choice("none", "layer")

    @property
    def minibatch(self) -> int:
        return self.policy_batch_size

    @property
    def learns_by_sac(self) -> bool:
        return True


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImaginationSettings(SacSettings):
    """Of `imagination`, which rolls these policies out."""

    rollout_starts: int = whole(1, MOST_ROWS)
    imagined_capacity: int = whole(1)
    horizon_first: int = whole(1)
    horizon_last: int = whole(1)
    horizon_ramp_start: float = real(0)
    horizon_ramp_end: float = real(0)
    rollout_models: str = choice("own", "any")

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        yield from super().contradictions()
        ends = self.horizon_ramp_end > self.horizon_ramp_start
        yield not ends, "horizon_ramp_end: must be greater than horizon_ramp_start"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PosteriorSettings(Settings):
    """Of `posterior` and `mixing`: who acts, and from how much real data each learns."""

    eval_policy: str = choice("posterior", "best", "average")
    n_policies: int = whole(1)
    real_ratio: float = real(0, 1, traced=True)
    real_ratio_schedule: str = choice("constant", "linear", "bandit")
    real_ratio_arms: tuple[float, ...] = real(0, 1)
    temperature: float = real(0, open_low=True, traced=True, infinite=True)  # ∞ is uniform sampling, equation 18
    weights: str = choice("returns", "values")
    posterior: str = choice("sample", "average")

    @property
    def policies_per_model(self) -> int:
        return self.n_policies

    @property
    def adapts_real_ratio(self) -> bool:
        """Whether λ is chosen online."""
        return self.real_ratio_schedule == "bandit"

    @property
    def weighs_values(self) -> bool:
        return self.weights == "values"

    @property
    def averages_members(self) -> bool:
        return self.posterior == "average"

    def may_change(self, name: str) -> bool:
        falls = self.real_ratio_schedule == "linear"  # over the whole run
        return super().may_change(name) and not (falls and name == "total_steps")

    @property
    def imagines(self) -> bool:
        """Whether any lane ever learns from imagined data (λ < 1)."""
        ratios = dict(self.sweep).get("real_ratio", (self.real_ratio,))
        if self.adapts_real_ratio:
            ratios = self.real_ratio_arms
        return self.real_ratio_schedule == "linear" or min(ratios) < 1

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        yield from super().contradictions()
        arms = ", ".join(f"{arm:g}" for arm in self.real_ratio_arms)
        yield (
            self.real_ratio_schedule != "constant" and "real_ratio" in dict(self.sweep),
            "sweep.real_ratio: needs real_ratio_schedule=constant",
        )
        yield list(self.real_ratio_arms) != sorted(set(self.real_ratio_arms)), f"real_ratio_arms=[{arms}]: must rise"
        yield (
            self.adapts_real_ratio and self.averages_members,
            "posterior=average: no policy earns what real_ratio_schedule=bandit would choose by",
        )
