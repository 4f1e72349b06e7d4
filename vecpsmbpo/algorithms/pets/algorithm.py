"""PETS for one seed: model-predictive control in the N models."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.algorithms.pets import planning
from vecpsmbpo.algorithms.pets.settings import PetsSettings
from vecpsmbpo.types import Counters, Model, SeedState, Stats


class Planner(struct.PyTreeNode):
    """A member that plans: it has nothing to learn."""

    stats: Stats


class Pets(Algorithm):
    """Model-predictive control; an episode remembers its plan, from which the next one starts."""

    settings: PetsSettings

    def init_agent(self, key: PRNGKeyArray) -> Planner:
        return Planner(stats=Stats.zero())

    def memory(self) -> Float[Array, "H A"]:
        """The plan, whose first action is taken now: of the middle of every range."""
        return jnp.zeros((self.settings.plan_horizon, self.spec.action_size))

    def choose(
        self, counters: Counters, state: SeedState, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """The first action of the plan. Nothing is planned during the warm-up, when actions are random."""
        steps = counters.env_steps
        due = (steps % self.settings.plan_hold == 0) & (steps >= self.settings.warmup_steps)
        return self._follow(due, self.layout.all_models(state.models), state.memory, obs, key)

    def evaluation_policy(self, state: SeedState, key: PRNGKeyArray) -> Model:
        return self.layout.all_models(state.models)

    def evaluation_action(
        self, policy: Model, step: Int[Array, ""], memory: Any, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """As `choose`: planning is the same in training and evaluation."""
        return self._follow(step % self.settings.plan_hold == 0, policy, memory, obs, key)

    def refresh(
        self, counters: Counters, state: SeedState, enabled: Bool[Array, ""], key: PRNGKeyArray
    ) -> tuple[Counters, SeedState]:
        return counters, self.fit_models(counters, state, enabled, key)

    def work(self, learning: np.ndarray, refreshes: np.ndarray) -> tuple[int, int]:
        """A plan is made for every `plan_hold` steps, and imagines as many for each planned action."""
        settings = self.settings
        rollouts = settings.plan_population * settings.plan_iterations * settings.plan_particles
        return 0, len(learning) * rollouts * settings.plan_horizon

    def _follow(
        self,
        due: Bool[Array, ""],
        models: Model,
        plan: Float[Array, "H A"],
        obs: Float[Array, " O"],
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, " A"], Float[Array, "H A"]]:
        """The action and the plan; a new one where `due`, which must not be batched over seeds or
        episodes: a batched condition would plan always."""
        settings = self.settings
        earned = partial(planning.expected_returns, net=self.model_net, settings=settings, spec=self.spec)

        def value(plans, key):
            def part(plans, ids):
                return earned(models, obs, plans, jax.random.fold_in(key, ids[0]))

            return self.layout.map_sharded(part, plans)

        def anew(plan):
            shifted = jnp.concatenate([plan[1:], jnp.zeros_like(plan[:1])])
            return planning.cross_entropy(value, shifted, key, settings)

        plan = jax.lax.cond(due, anew, lambda plan: plan, plan)
        return plan[0], plan
