"""What a checkpoint holds of one lane: its policies and models, outside of the program that trained them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vecpsmbpo import posterior, sac
from vecpsmbpo.algorithms import Algorithm
from vecpsmbpo.drivers.common import evaluation_policies
from vecpsmbpo.evaluate import restore
from vecpsmbpo.look.runs import Run
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import SeedState

Array = np.ndarray
Act = Callable[[Any], jax.Array]  # obs [..., O] -> mean action [..., A]


@dataclass(frozen=True)
class Trained:
    """One lane of a run's newest checkpoint.

    Attributes:
        step: environment steps when it was written.
        index: of the lane.
        state: of all lanes, leaves [S, ...].
    """

    run: Run
    algorithm: Algorithm
    step: int
    index: int
    state: SeedState

    def of_lane(self, tree: Any) -> Any:
        """The lane's part of leaves [S, ...]."""
        return jax.tree.map(lambda x: x[self.index], tree)

    @property
    def has_members(self) -> bool:
        """Whether policies learn by SAC, so that each can be asked by itself."""
        settings = self.run.settings
        return not (settings.plans or settings.alternates)

    def actors(self) -> Any:
        """Parameters of every member's policy, leaves [N·M, ...]."""
        places = self.algorithm.layout.places_of_members
        return jax.tree.map(lambda x: x[places], self.of_lane(self.state.agents.actor))

    def best(self) -> int:
        """The member that has earned the most."""
        return int(posterior.best(self.of_lane(self.state.posterior)))


def load(run: Run, lane: int = 0) -> Trained:
    """A lane of the run's newest checkpoint.

    Raises:
        SettingError: there is no checkpoint, or no such lane.
    """
    settings = run.settings
    if lane >= len(settings.lanes):
        raise SettingError(f"lane={lane}: must be below {len(settings.lanes)}, the lanes of {run.path}")
    driver, saved = restore(settings)
    return Trained(run, driver.algorithm, saved.step, lane, saved.state.seeds)


def acting(trained: Trained, member: str) -> list[tuple[str, Act]]:
    """The policies that `member` names, each with its own name.

    Args:
        member: `best`, `posterior` (drawn now), `all`, or `n,m`.

    Raises:
        SettingError: the algorithm plans, has no members, or not this one.
    """
    settings = trained.run.settings
    if settings.plans:
        raise SettingError(f"run_dir={trained.run.path}: algo={settings.algo} plans its actions; there is no policy")
    if member in ("best", "posterior"):
        return [(member, _evaluated(trained, member))]
    if not trained.has_members:
        raise SettingError(f"member={member}: must be best or posterior with algo={settings.algo}")
    names = member_names(trained.run)
    if member != "all" and member not in names:
        raise SettingError(f"member={member}: must be best, posterior, all or one of {'  '.join(names)}")
    actor, actors = sac.make_networks(settings, trained.algorithm.spec).actor, trained.actors()

    def policy(index: int) -> Act:
        params = jax.tree.map(lambda x: x[index], actors)
        return jax.jit(lambda obs: actor.law(params, obs).mode())

    return [(name, policy(index)) for index, name in enumerate(names) if member in ("all", name)]


def member_names(run: Run) -> list[str]:
    """`n,m` of every member, as `member=` takes them; `0,m` where policies belong to no model."""
    m, own = run.settings.n_policies, run.settings.rollout_models == "own"
    return [f"{index // m},{index % m}" if own else f"0,{index}" for index in range(run.settings.n_members)]


def _evaluated(trained: Trained, who: str) -> Act:
    """The mean action of the policy that `eval_policy=who` evaluates; with `posterior=average`, where nobody earns
    anything, the mean of all members' actions."""
    settings = trained.run.settings
    settings = replace(settings, eval_policy=who, eval_actions="mean")
    if settings.posterior == "average":
        actor, actors = sac.make_networks(settings, trained.algorithm.spec).actor, trained.actors()
        return jax.jit(lambda obs: jax.vmap(lambda params: actor.law(params, obs).mode())(actors).mean(axis=0))
    algorithm = replace(trained.algorithm, settings=settings)
    chosen = trained.of_lane(evaluation_policies(algorithm)(trained.state, trained.state.key))
    step, key = jnp.int32(0), jax.random.key(0)  # a policy, unlike a plan, needs neither
    return jax.jit(lambda obs: algorithm.evaluation_action(chosen, step, algorithm.memory(), obs, key)[0])
