"""Ring buffer of packed transitions: pure functions over one [C, F] array.

A transition is one row of F = 2 O + A + 2 floats, so that drawing a minibatch is one gather. The number of rows
ever added is kept by the caller (see `types.Counters`).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vecpsmbpo.types import Transition, Whole


def row_size(obs_size: int, action_size: int) -> int:
    """F."""
    return 2 * obs_size + action_size + 2


def init(capacity: int, obs_size: int, action_size: int) -> Float[Array, "C F"]:
    """An empty ring."""
    return jnp.zeros((capacity, row_size(obs_size, action_size)), jnp.float32)


def pack(transition: Transition) -> Float[Array, "*batch F"]:
    """Transition with leaves [..., O], [..., A], [...] -> rows."""
    obs, action, reward, next_obs, terminated = transition
    scalars = jnp.stack([reward, terminated.astype(jnp.float32)], axis=-1)
    return jnp.concatenate([obs, action, next_obs, scalars], axis=-1).astype(jnp.float32)


def unpack(rows: Float[Array, "*batch F"], obs_size: int, action_size: int) -> Transition:
    """The inverse of `pack`."""
    obs, action, next_obs, scalars = jnp.split(
        rows, [obs_size, obs_size + action_size, 2 * obs_size + action_size], axis=-1
    )
    return Transition(obs, action, scalars[..., 0], next_obs, scalars[..., 1])


def add(ring: Float[Array, "*rings C F"], rows: Float[Array, "*rings B F"], added: Whole) -> Float[Array, "*rings C F"]:
    """Writes rows into every ring after the `added` rows that it has received so far.

    B must divide C, and every earlier block must have been of B rows too: a block never wraps.
    """
    position = added % ring.shape[-2]
    start = [jnp.int32(0)] * (ring.ndim - 2) + [position, jnp.int32(0)]
    return jax.lax.dynamic_update_slice(ring, rows, start)


def sample_indices(key: PRNGKeyArray, shape: tuple[int, ...], added: Whole, capacity: int) -> Int[Array, "..."]:
    """Uniform indices of stored rows, of this shape, with replacement. An empty ring gives zeros."""
    return jax.random.randint(key, shape, 0, jnp.clip(added, 1, capacity))


def sample_newest_indices(
    key: PRNGKeyArray, shape: tuple[int, ...], added: Whole, capacity: int, newest: Whole
) -> Int[Array, "..."]:
    """As `sample_indices`, of the `newest` rows only."""
    age = jax.random.randint(key, shape, 0, jnp.clip(jnp.minimum(added, newest), 1, capacity))
    return (added - 1 - age) % capacity


def wrapped(added: Whole, capacity: int) -> Int[Array, ""]:
    """The `added` rows, less whole turns of a full ring: position and fullness stay, and int32 never overflows."""
    return jnp.where(added < capacity, added, capacity + added % capacity)
