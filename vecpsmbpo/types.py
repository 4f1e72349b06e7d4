"""The values that pass between the rooms of this program.

Axes, by the same letters everywhere: S seeds (each with every swept value), N models, M policies per model, P = N·M
members (rounded up to the mesh, see `layout`), B batch, T time, O observation, A action, C capacity, F packed row.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from vecpsmbpo.settings import Settings, fields

# Signatures give shapes in these letters, `*batch` for any leading axes: Float[Array, "*batch O"]. Others (H, K, D) are
# the function's own. Tests check them where functions are traced (tests/shapes.py); a run does not.
Params = Any  # a pytree of arrays
Number = Float[Array, ""] | float  # scalars, traced or not
Whole = Int[Array, ""] | int
Flag = Bool[Array, ""] | bool
TerminationRule = Callable[
    [Float[Array, "*batch O"], Float[Array, "*batch A"], Float[Array, "*batch O"]], Bool[Array, "*batch"]
]

LARGEST_NUMBER = 1e10  # MuJoCo's own bound (mjMAXVAL) on what it computes with


def possible(x: Any) -> Any:
    """Which numbers of an array a simulator can mean: not those of one that has diverged, on its way to infinity or
    there."""
    return abs(x) <= LARGEST_NUMBER  # False for NaN


@dataclass(frozen=True)
class EnvSpec:
    """What a task is, apart from its simulator.

    Attributes:
        name: the task's name, as in `env=`.
        obs_size: O.
        action_size: A; actions lie in [-1, 1].
        episode_length: control steps after which an episode is truncated.
        terminated: (obs [..., O], action [..., A], next_obs [..., O]) -> bool [...]. The task's own termination
            rule as a function of observations; imagined rollouts end by it. None: not known, and the dynamics models
            learn it from real terminations.
    """

    name: str
    obs_size: int
    action_size: int
    episode_length: int
    terminated: TerminationRule | None


class Transition(NamedTuple):
    """(s, a, r, s', terminated). `next_obs` is the true successor, also where the episode ended.

    Shapes: obs [..., O], action [..., A], reward [...], next_obs [..., O], terminated [...] in {0, 1}.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    next_obs: jax.Array
    terminated: jax.Array


@jax.tree_util.register_pytree_with_keys_class
class Hyper:
    """What may be swept as a number: every setting of the algorithm that is marked `traced`, by its name. Scalars here
    and [S] in a train state. Checkpoints know their names and order."""

    def __init__(self, **values: Any):
        vars(self).update(values)

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any: ...

    @classmethod
    def of(cls, settings: Settings) -> "Hyper":
        return cls(**{name: jnp.float32(getattr(settings, name)) for name in fields.traced(type(settings))})

    def replace(self, **values: Any) -> "Hyper":
        return Hyper(**{**vars(self), **values})

    def tree_flatten_with_keys(self) -> tuple[Any, Any]:
        names = tuple(vars(self))
        return [(jax.tree_util.GetAttrKey(name), getattr(self, name)) for name in names], names

    @classmethod
    def tree_unflatten(cls, names: Any, leaves: Any) -> "Hyper":
        return cls(**dict(zip(names, leaves, strict=True)))


class Prior(struct.PyTreeNode):
    """β f_θ0 of equation 34: a function drawn once, which the model's own is added to.

    Attributes:
        params: θ0, of `networks.GaussianMLP`.
        scale: [], β.
    """

    params: Params
    scale: jax.Array


class Scaling(NamedTuple):
    """Units of a model's inputs and outputs.

    Attributes:
        input_mean, input_std: [O + A], of all real data at the last fit (equation 20).
        output_std: [O + 1], of the changes and the reward; 1 where they are predicted as they are (A.1).
    """

    input_mean: jax.Array
    input_std: jax.Array
    output_std: jax.Array


class Model(struct.PyTreeNode):
    """One dynamics model.

    Attributes:
        params: of `networks.GaussianMLP`.
        optimizer: state of Adam; it lives on from refit to refit.
        scaling: see `Scaling`.
        loss: [], mean of what the last epoch of the last fit descended (`dynamics.loss`: equation 17, or weighted).
        val_mse: [], validation mean squared error of the parameters kept; None where the fit does not validate.
        prior: or None, where β = 0.
    """

    params: Params
    optimizer: Any
    scaling: Scaling
    loss: jax.Array
    val_mse: jax.Array | None
    prior: Prior | None


class Stats(struct.PyTreeNode):
    """Sums over this epoch's updates of one member; every leaf [].

    An algorithm adds a field for each number that its updates report: the mean over updates is logged by that name.
    """

    updates: jax.Array

    @classmethod
    def zero(cls) -> Self:
        return cls(*jnp.zeros(len(cls.__dataclass_fields__)))


class Posterior(struct.PyTreeNode):
    """q(π | D, λ), as far as it has memory: what each member has earned.

    Attributes:
        returns: [N·M], sum of the returns of each member's finished, non-random episodes (equation 19).
        compensation: [N·M], low-order part of `returns` that float32 addition lost (Kahan).
        episodes: [N·M] int, how many those were.
    """

    returns: jax.Array
    compensation: jax.Array
    episodes: jax.Array


class Episode(struct.PyTreeNode):
    """The real episode that is running.

    Attributes:
        index: [] int, k from 1.
        warmups: [] int, how many of the episodes so far began within the warm-up.
        member: [] int, n·M + m of the acting policy; -1 where all of them act (`posterior=average`).
        random: [] bool, actions are uniform and the return is not credited.
        probs: [N·M], the distribution that `member` was drawn from.
        values: [N·M] that it was made of (`weights=values`), or None.
        episode_return, length: [] so far.
    """

    index: jax.Array
    warmups: jax.Array
    member: jax.Array
    random: jax.Array
    probs: jax.Array
    values: jax.Array | None
    episode_return: jax.Array
    length: jax.Array


class EpisodeEnd(struct.PyTreeNode):
    """One real step's news for `episodes.jsonl`: meaningful where `done`.

    Shapes: probs and values (or None) [N·M]; every other leaf [].
    """

    done: jax.Array
    index: jax.Array
    member: jax.Array
    random: jax.Array
    terminated: jax.Array
    episode_return: jax.Array
    length: jax.Array
    probs: jax.Array
    values: jax.Array | None

    @classmethod
    def blank(cls, shape: tuple[int, ...], settings: Settings) -> "EpisodeEnd":
        """Room for the news of `shape` steps."""
        flag, count, number = (jnp.zeros(shape, dtype) for dtype in (bool, jnp.int32, jnp.float32))
        probs = jnp.zeros((*shape, settings.n_members))
        values = probs if settings.weighs_values else None
        return cls(flag, count, count, flag, flag, number, count, probs, values)


class Moments(struct.PyTreeNode):
    """Running moments of (observation, action, Δs, r) over D_E (Welford).

    Attributes:
        mean, deviation: [2 O + A + 1] each; a deviation is a sum of squares.
        lowest_reward, highest_reward: [], of D_E and 0.
        inputs: O + A.
    """

    mean: jax.Array
    deviation: jax.Array
    lowest_reward: jax.Array
    highest_reward: jax.Array
    inputs: int = struct.field(pytree_node=False)


class Health(struct.PyTreeNode):
    """Where and when something of a lane stopped being finite; the codes are `health`'s. Every leaf [] int32.

    Attributes:
        code: of what first was not finite, from when on the lane is frozen.
        env_steps: at the end of the stride in which that was.
        passing: code of something not finite that passed by in the running stride and is not part of the state.
    """

    code: jax.Array
    env_steps: jax.Array
    passing: jax.Array


class SeedState(struct.PyTreeNode):
    """Everything one seed owns. In a train state every leaf has a leading [S]; models, agents and imagined data
    have their member axis next and are spread over the mesh along it.

    Attributes:
        key: typed PRNG key.
        hyper: see `Hyper`.
        models: `Model` with leading [N].
        agents: what the algorithm has for a member, such as `sac.Agent`, with leading [P].
        real: [C, F], D_E: packed transitions, a ring.
        newest: [F], the row that `real` received last; zeros before the first. (Reading it from a ring that is written
            in the same step makes XLA copy the ring.)
        imagined: [P, C_M, F], D_M^{n,m}: one ring per member; None where nothing is imagined for later.
        moments: of D_E, for whitening.
        posterior, episode: who acts, and how it is going.
        memory: what acting remembers within an episode.
        own: what the algorithm knows besides.
        epoch_return, epoch_episodes: [], sum and number of the returns of the episodes that ended this epoch.
        epoch_unsound: [], steps of this epoch at which the simulator diverged (`possible`).
        health: whether the lane is frozen.
    """

    key: jax.Array
    hyper: Hyper
    models: Model
    agents: Any
    real: jax.Array
    newest: jax.Array
    imagined: jax.Array | None
    moments: Moments
    posterior: Posterior
    episode: Episode
    memory: Any
    own: Any
    epoch_return: jax.Array
    epoch_episodes: jax.Array
    epoch_unsound: jax.Array
    health: Health

    def rings(self) -> dict[str, Any]:
        """D_E and D_M^{n,m}, those that there are: nearly all of its bytes."""
        rings = {"real": self.real, "imagined": self.imagined}
        return {name: ring for name, ring in rings.items() if ring is not None}


class Counters(NamedTuple):
    """Shared by all seeds, since every seed adds one row per step: ring positions stay unbatched under `vmap`, so
    that writing a row is an in-place update and not a scatter.

    Shapes: [] int32 each.
    """

    env_steps: jax.Array
    imagined_rows: jax.Array


class TrainState(struct.PyTreeNode):
    """A run between two chunks.

    Attributes:
        counters: see `Counters`.
        seeds: `SeedState` with leading [S].
        env: state of the MJX environments with leading [S], or the current observations [S, O] of host ones.
    """

    counters: Counters
    seeds: SeedState
    env: Any

    def without_rings(self) -> "TrainState":
        """All but D_E and D_M^{n,m}."""
        return self.replace(seeds=self.seeds.replace(real=None, imagined=None))
