"""The settings of PETS."""

import dataclasses
from collections.abc import Iterator

from vecpsmbpo.settings.fields import choice, whole
from vecpsmbpo.settings.parts import FitSettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class PetsSettings(FitSettings):
    """Of plans, made by the cross-entropy method over rollouts in the models."""

    rollout_models: str = choice("own", "any")
    plan_horizon: int = whole(1)
    plan_hold: int = whole(1)
    plan_population: int = whole(2)
    plan_elites: int = whole(1)
    plan_iterations: int = whole(1)
    plan_particles: int = whole(1)

    @property
    def plans_actions(self) -> bool:
        return True

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        yield from super().contradictions()
        yield (
            self.plan_elites > self.plan_population,
            f"plan_elites={self.plan_elites}: must be at most plan_population",
        )
        yield (
            self.plan_particles % self.n_models != 0,
            f"plan_particles={self.plan_particles}: must be a multiple of n_models={self.n_models}",
        )
