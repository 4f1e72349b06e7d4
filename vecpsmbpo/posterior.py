"""q(π | D, λ): which member acts (equations 18 and 19), and when none of them does (equation 33)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vecpsmbpo.types import Episode, Flag, Number, Posterior, Whole

STARTS = 32  # K, episodes whose first observations members are asked about


def init(members: int) -> Posterior:
    """Nobody has earned anything."""
    return Posterior(jnp.zeros(members), jnp.zeros(members), jnp.zeros(members, jnp.int32))


def credit(posterior: Posterior, member: Whole, episode_return: Number, enabled: Flag) -> Posterior:
    """Adds an episode's return to its member where `enabled` (equation 19 sums over all past episodes).

    Compensated (Kahan) addition: after hundreds of episodes of thousands, plain float32 sums would be off by more
    than the 1e-5 to which the probabilities can be recomputed from the log.
    """
    credited = (jnp.arange(posterior.returns.shape[0]) == member) & enabled
    gain = jnp.where(credited, episode_return, 0.0) - posterior.compensation
    total = posterior.returns + gain
    compensation = (total - posterior.returns) - gain
    return Posterior(total, compensation, posterior.episodes + credited)


def add_start(
    starts: Float[Array, "K O"] | None, episode: Episode, obs: Float[Array, " O"]
) -> Float[Array, "K O"] | None:
    """The ring with the first observation of this episode; unchanged at its later steps."""
    if starts is None:
        return None
    place = (episode.index - 1) % STARTS
    return starts.at[place].set(jnp.where(episode.length == 0, obs, starts[place]))


def logits(
    posterior: Posterior, values: Float[Array, " members"] | None, temperature: Number
) -> Float[Array, " members"]:
    """Accumulated return / τ (equation 19), or value / τ where there are `values`.

    τ = ∞ gives the uniform distribution of equation 18.
    """
    if values is not None:
        return (values - jnp.max(values)) / temperature
    centred = posterior.returns - jnp.max(posterior.returns)  # before dividing: keeps small differences exact
    return (centred - posterior.compensation) / temperature


def best(posterior: Posterior) -> Int[Array, ""]:
    """The member of highest mean return, of those that acted in enough episodes to tell.

    Enough are half as many as there would be had all members acted equally often, and at least one: the mean of the
    fewest is then at most √2 times as uncertain as that of an average member, and some member always has them. (The sum
    of equation 19 says who acted often and, where returns are negative, who did not.) Before the first episode that
    counts, member 0.
    """
    episodes = posterior.episodes
    mean = posterior.returns / jnp.maximum(episodes, 1)
    enough = (episodes > 0) & (2 * episodes * episodes.shape[0] >= jnp.sum(episodes))
    return jnp.argmax(jnp.where(enough, mean, -jnp.inf))


def draw(logits: Float[Array, " members"], key: PRNGKeyArray) -> tuple[Int[Array, ""], Float[Array, " members"]]:
    """A member, and the distribution that it was drawn from."""
    return jax.random.categorical(key, logits), jax.nn.softmax(logits)


def exploration_probability(
    forced_exploration: Number, episode: Int[Array, "*episodes"] | int
) -> Float[Array, "*episodes"]:
    """min(1, τ / k): with it the k-th episode after the warm-up, from 1, takes random actions (equation 33)."""
    return jnp.minimum(1.0, forced_exploration / episode)
