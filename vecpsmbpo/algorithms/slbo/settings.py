"""The settings of SLBO."""

import dataclasses
from collections.abc import Iterator

from vecpsmbpo.settings.fields import real, whole
from vecpsmbpo.settings.parts import PolicySettings


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlboSettings(PolicySettings):
    """Of a model and a policy that learn in turns at every refresh."""

    rounds: int = whole(1)
    model_steps: int = whole(1)
    model_steps_ahead: int = whole(1)
    policy_steps: int = whole(1)
    policy_rollouts: int = whole(1)
    policy_rollout_length: int = whole(1)
    trust_region: float = real(0, open_low=True)
    discount: float = real(0, 1, traced=True)
    gae_decay: float = real(0, 1)
    entropy_weight: float = real(0)

    def contradictions(self) -> Iterator[tuple[bool, str]]:
        yield from super().contradictions()
        yield self.n_models != 1, f"n_models={self.n_models}: must be 1 with algo=slbo"
