"""The settings of PS-MBPO, OPS-MBPO, MBPO and SAC."""

import dataclasses
from collections.abc import Iterator

from vecpsmbpo.settings.parts import FitSettings, ImaginationSettings, PosteriorSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class PsMbpoSettings(PosteriorSettings, ImaginationSettings, FitSettings):
    """Policies that learn by SAC from real and imagined data."""

    @property
    def summary(self) -> str:
        where = " in all of them" if self.rollout_models == "any" else ""
        members = f"N = {self.n_models} models × M = {self.n_policies} policies{where}"
        return f"{members}, {self.updates_per_step} updates per step"

    @property
    def n_members(self) -> int:
        """The policies that the posterior draws from: N·M, or M where none belongs to a model."""
        return self.n_policies * (self.n_models if self.rollout_models == "own" else 1)

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        yield from super().contradictions()
        longest = max(self.horizon_first, self.horizon_last)
        yield (
            self.imagines and self.imagined_capacity < longest,
            f"imagined_capacity={self.imagined_capacity}: must hold a rollout, of up to {longest} steps",
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class RealDataSettings(PsMbpoSettings):
    """SAC: one policy, which learns from real data alone (λ = 1, equation 15)."""

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        for name in ("n_models", "n_policies"):
            yield getattr(self, name) != 1, f"{name}={getattr(self, name)}: must be 1 with algo={self.algo}"
        moves = self.real_ratio_schedule != "constant" or "real_ratio" in dict(self.sweep)
        yield moves or self.real_ratio != 1, f"real_ratio: must be 1 with algo={self.algo}, and stay there"
        for name, _ in self.sweep:
            unused = name.startswith("model_") or name in ("prior_scale", "temperature")
            yield (
                unused,
                f"sweep.{name}: algo={self.algo} has one policy and no model; its values all do the same",
            )
        yield from super().contradictions()
