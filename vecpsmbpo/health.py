"""A lane in which something stops being finite is frozen at its last good state, and the others go on.

A lane is a seed with its swept values. At the end of every stride all of it is looked at but the rings, whose rows are
looked at before they are written. Where something is not finite, the lane is put back to where the stride began, in
that stride and in every later one. It is computed on, since shapes are fixed, and its rings receive rows, since their
positions are shared (`own_rows` says which are its own); but nothing that is logged, credited or evaluated sees any of
it.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vecpsmbpo.layout import Layout
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import Health, SeedState, TrainState, Whole, possible

# A code is a rank times `_WIDTH` plus the index of a member or model. Ranks are the entries of `PASSING` and then
# the leaves of the state. Of several the smallest leaf is named; what passed by is as a rule its consequence.
NOWHERE = np.int32(2**31 - 1)
_WIDTH = 2**16
ACTION, IMAGINED = "an action", "imagined data"
PASSING = (ACTION, IMAGINED)
MODELS, AGENTS = "models", "agents"


def init() -> Health:
    """All is well."""
    nowhere = jnp.int32(NOWHERE)
    return Health(code=nowhere, env_steps=jnp.int32(0), passing=nowhere)


def note(health: Health, what: str, bad: Bool[Array, "*S"], member: Whole = 0) -> Health:
    """Remembers, where `bad`, that `what` of `PASSING` was not finite."""
    code = jnp.where(bad, PASSING.index(what) * _WIDTH + member, NOWHERE)
    return health.replace(passing=jnp.minimum(health.passing, code))


def frozen(health: Health) -> Any:
    """Which lanes are, [S] bool (or [] of one)."""
    return health.code != NOWHERE


def own_rows(health: Health, step: int, stride: int) -> Any:
    """How many rows of D_E, of those of `step` environment steps, are what the lanes have seen, [S]: a frozen lane's
    end with the state that it is held at."""
    return np.where(frozen(health), np.asarray(health.env_steps) - stride, step)


def settle(layout: Layout, before: TrainState, after: TrainState) -> tuple[TrainState, jax.Array]:
    """Ends a stride: freezes lanes in which something is not finite, and puts the frozen ones back.

    Args:
        before: the state without rings that the stride began with. What is looked at is all finite in it; where the
            environment has just been reset to NaN, that is not, until the next step mends it.

    Returns:
        `after` with the lanes that are frozen as in `before`, their rings excepted; and which these are, [S] bool.
    """
    was, seeds = before.seeds.health, after.seeds
    found = jax.vmap(partial(_first_not_finite, layout))(seeds)
    found = jnp.where(found == NOWHERE, seeds.health.passing, found)
    code = jnp.where(frozen(was), was.code, found)
    now = code != NOWHERE
    env_steps = jnp.where(now & ~frozen(was), after.counters.env_steps, was.env_steps)
    health = Health(code=code, env_steps=env_steps, passing=jnp.full_like(code, NOWHERE))

    held = jax.tree.map(
        lambda old, new: jax.vmap(jnp.where)(now, old, new),
        (before.seeds, before.env),
        (after.without_rings().seeds, after.env),
    )
    seeds = held[0].replace(**seeds.rings(), health=health)
    return after.replace(seeds=seeds, env=held[1]), now


def sound(
    obs: Float[Array, "*batch O"], reward: Float[Array, "*batch"], next_obs: Float[Array, "*batch O"]
) -> Bool[Array, "*batch"]:
    """Whether a step's numbers are possible."""
    return possible(obs).all(axis=-1) & possible(next_obs).all(axis=-1) & possible(reward)


def _leaves(seeds: SeedState) -> list[tuple[str, str, Any]]:
    """What is looked at: part of the state, name and value of every leaf of real numbers.

    Not hyperparameters, which may be infinite (τ of equation 18) and do not change.
    """
    looked_at = seeds.replace(real=None, imagined=None, hyper=None, health=None)
    return [
        (path[0].name, jax.tree_util.keystr(path).lstrip("."), leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(looked_at)
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    ]


def _first_not_finite(layout: Layout, state: SeedState) -> jax.Array:
    """The code of it in one seed, [] int32; members and models that fill the mesh do not count."""
    own = {MODELS: (layout.model_ids(), layout.n_models), AGENTS: (layout.member_ids(), layout.n_members)}
    found = jnp.int32(NOWHERE)
    for rank, (part, _, leaf) in enumerate(_leaves(state), start=len(PASSING)):
        ids, count = own.get(part, (jnp.zeros(1, jnp.int32), 1))
        bad = ~jnp.isfinite(leaf).reshape(ids.shape[0], -1).all(axis=1) & (ids < count)
        found = jnp.minimum(found, jnp.min(jnp.where(bad, rank * _WIDTH + ids, NOWHERE)))
    return layout.least_of_members(found)


def describe(seeds: SeedState, lane: int, settings: Settings) -> str:
    """Where the fault of a frozen lane appeared, in words."""
    rank, index = divmod(int(seeds.health.code[lane]), _WIDTH)
    if rank < len(PASSING):
        part, name = (AGENTS if PASSING[rank] == IMAGINED else ""), PASSING[rank]
    else:
        part, name, _ = _leaves(seeds)[rank - len(PASSING)]
    if part == MODELS:
        return f"{name} of model n = {index}"
    if part == AGENTS:
        return f"{name} of policy n = {index // settings.policies_per_model}, m = {index % settings.policies_per_model}"
    return name
