"""What a checkpoint holds of one lane: its policies and models, outside of the program that trained them."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vecpsmbpo import health, networks, posterior, replay, sac
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.checkpoint import Saved
from vecpsmbpo.drivers.common import evaluation_policies
from vecpsmbpo.evaluate import restore, restore_each
from vecpsmbpo.feedforward import Feedforward
from vecpsmbpo.layout import BY_SEED
from vecpsmbpo.look.runs import Run, check_lane
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import Model, SeedState

Array = np.ndarray
Act = Callable[[Any], jax.Array]  # obs [..., O] -> mean action [..., A]


@dataclass(frozen=True)
class Trained:
    """One lane of a run's newest checkpoint.

    Attributes:
        step: environment steps when it was written.
        index: of the lane.
        state: of all lanes, leaves [S, ...].
        imagined_rows: that every ring has received (`replay.wrapped`: of very many a smaller number, with the same
            place in the ring).
    """

    run: Run
    algorithm: Algorithm
    step: int
    index: int
    state: SeedState
    imagined_rows: int

    def of_lane(self, tree: Any) -> Any:
        """The lane's part of leaves [S, ...]."""
        return jax.tree.map(lambda x: x[self.index], tree)

    @property
    def has_members(self) -> bool:
        """Whether each policy, and its critics, can be asked by itself."""
        return self.run.settings.learns_by_sac

    @property
    def nets(self) -> sac.Networks:
        """Of its policies, where it `has_members`."""
        nets: sac.Networks = self.algorithm.nets
        return nets

    def actors(self) -> Any:
        """Parameters of every member's policy, leaves [N·M, ...]."""
        return self._some(self._members, self.state.agents.actor)

    def feedforward(self, member: int) -> Feedforward:
        """A member's mean action as matrices, where it does not plan."""
        if self.has_members:
            policy = jax.tree.map(lambda x: x[member], self.actors())
        else:
            policy = self.of_lane(evaluation_policies(self.algorithm)(self.state, self.state.key))
        found = self.algorithm.feedforward(policy)
        assert found is not None
        return found

    def critics(self) -> tuple[Any, Array]:
        """Parameters of every member's critics, leaves [N·M, ...], and its entropy coefficient α, [N·M]."""
        agents = self.state.agents
        return self._some(self._members, agents.critic), np.exp(np.asarray(self._some(self._members, agents.log_alpha)))

    def models(self) -> Model | None:
        """Leaves [N, ...]; None where none has been fitted yet."""
        models: Model = self._some(np.arange(self.run.settings.n_models), self.state.models)
        return models if np.asarray(models.optimizer.count).min() > 0 else None

    def real_states(self, most: int, random: np.random.Generator) -> Array:
        """[..., O], some of the observations that real steps of D_E led to."""
        ring = self.state.real[self.index]
        return self._observations(ring, random.permutation(min(self.step, len(ring)))[:most])

    def imagined_states(self, most: int, random: np.random.Generator) -> Array | None:
        """[..., O], some of the observations that imagined steps led to, of those that policies learn from now, of all
        members; None where nothing is imagined, or the lane is frozen, whose rings hold what nobody learns from."""
        if not self.imagined_rows or health.frozen(self.state.health)[self.index]:
            return None
        assert self.state.imagined is not None
        rings = self.state.imagined[self.index][self._members]
        newest = min(self.imagined_rows, int(self.algorithm.retained_rows(jnp.int32(self.step))))
        rows = (self.imagined_rows - 1 - random.integers(0, newest, most)) % rings.shape[1]
        return self._observations(rings, (random.integers(0, len(rings), most), rows))

    def _observations(self, ring: Any, place: Any) -> Array:
        spec = self.algorithm.spec
        return np.asarray(replay.unpack(ring[place], spec.obs_size, spec.action_size).next_obs)

    @property
    def _members(self) -> Array:
        return self.algorithm.layout.places_of_members

    def _some(self, places: Array, tree: Any) -> Any:
        """The lane's models or members at `places`, on one device."""
        return jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[places]), self.of_lane(tree))

    def best(self) -> int:
        """The member that has earned the most per episode (`posterior.best`)."""
        return int(posterior.best(self.of_lane(self.state.posterior)))

    def drawn(self) -> int:
        """A member that the posterior draws now, where it `has_members`: the one that `eval_policy=posterior` evaluates
        with the same key."""
        algorithm: Any = self.algorithm

        def draw(seed: SeedState, key: jax.Array) -> jax.Array:
            member: jax.Array = algorithm.draw(seed.posterior, algorithm.values(seed), seed.hyper, key)[0]
            return member

        seeds = algorithm.layout.specs().seeds
        program = algorithm.layout.jit_shard_map(jax.vmap(draw), (seeds, BY_SEED), BY_SEED)
        return int(self.of_lane(np.asarray(program(self.state, self.state.key))))


def load(run: Run, lane: int = 0) -> Trained:
    """A lane of the run's newest checkpoint.

    Raises:
        SettingError: there is no checkpoint, or no such lane.
    """
    check_lane(run, lane)
    driver, saved = restore(run.settings)
    return _trained(run, driver.algorithm, saved, lane)


def load_each(run: Run, lane: int = 0, steps: Collection[int] = ()) -> Iterator[Trained]:
    """As `load`, of every checkpoint that is kept and can be read, or of those at `steps`; oldest first.

    Raises:
        SettingError: there is none, or no such lane.
    """
    check_lane(run, lane)
    found = False
    for driver, saved in restore_each(run.settings, steps):
        found = True
        yield _trained(run, driver.algorithm, saved, lane)
        del saved  # as in `restore_each`
    if not found:
        raise SettingError(f"run_dir={run.path}: holds no checkpoint yet")


def _trained(run: Run, algorithm: Algorithm, saved: Saved, lane: int) -> Trained:
    return Trained(run, algorithm, saved.step, lane, saved.state.seeds, int(saved.state.counters.imagined_rows))


def acting(trained: Trained, member: str) -> list[tuple[str, Act]]:
    """The policies that `member` names, each with its own name, which says who it is: `best 1,0`.

    Args:
        member: `best`, `posterior` (one member, drawn now), `all`, or `n,m`.

    Raises:
        SettingError: the algorithm plans, has no members, or not this one.
    """
    settings, chosen = trained.run.settings, member in ("best", "posterior")
    if settings.plans_actions:
        raise SettingError(f"run_dir={trained.run.path}: algo={settings.algo} plans its actions; there is no policy")
    if not trained.has_members:
        if chosen:
            return [(member, _evaluated(trained, member))]
        raise SettingError(f"member={member}: must be best or posterior with algo={settings.algo}")
    if chosen and settings.averages_members:
        return [("all together", _averaged(trained))]
    names = member_names(trained.run)
    if not chosen and member not in ("all", *names):
        raise SettingError(f"member={member}: must be best, posterior, all or one of {'  '.join(names)}")
    actor, actors = trained.nets.actor, trained.actors()

    def policy(index: int) -> Act:
        return partial(_mean_action, jax.tree.map(lambda x: x[index], actors), actor=actor)

    if chosen:
        index = trained.best() if member == "best" else trained.drawn()
        return [(f"{member} {names[index]}", policy(index))]
    return [(name, policy(index)) for index, name in enumerate(names) if member in ("all", name)]


def member_names(run: Run) -> list[str]:
    """`n,m` of every member, as `member=` takes them; `0,m` where policies belong to no model."""
    m = run.settings.policies_per_model
    return [f"{index // m},{index % m}" for index in range(run.settings.n_members)]


# Compiled once for all members and checkpoints, whose parameters are arguments.


@partial(jax.jit, static_argnames="actor")
def _mean_action(params: Any, obs: Any, *, actor: networks.Actor) -> jax.Array:
    return actor.distribution(params, obs).mode()


@partial(jax.jit, static_argnames="algorithm")
def _evaluation_action(policy: Any, obs: Any, *, algorithm: Algorithm) -> jax.Array:
    step, key = jnp.int32(0), jax.random.key(0)  # a policy, unlike a plan, needs neither
    return algorithm.evaluation_action(policy, step, algorithm.memory(), obs, key)[0]


def _evaluated(trained: Trained, who: str) -> Act:
    """The mean action of the policy that `eval_policy=who` evaluates, where there are no members to ask."""
    wanted: dict[str, Any] = {"eval_policy": who, "eval_actions": "mean"}
    settings = trained.run.settings
    settings = replace(settings, **{name: value for name, value in wanted.items() if hasattr(settings, name)})
    algorithm = replace(trained.algorithm, settings=settings)
    chosen = trained.of_lane(evaluation_policies(algorithm)(trained.state, trained.state.key))
    return partial(_evaluation_action, chosen, algorithm=algorithm)


def _averaged(trained: Trained) -> Act:
    """The mean of all members' actions: of `posterior=average`, where nobody earns anything."""
    actor, actors = trained.nets.actor, trained.actors()
    return jax.jit(lambda obs: jax.vmap(lambda params: actor.distribution(params, obs).mode())(actors).mean(axis=0))
