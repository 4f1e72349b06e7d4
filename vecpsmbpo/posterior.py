"""q(π | D, λ): which member acts (equations 18 and 19), and when none of them does (equation 33)."""

import jax
import jax.numpy as jnp

from vecpsmbpo.types import Posterior


def init(members: int) -> Posterior:
    return Posterior(returns=jnp.zeros(members), compensation=jnp.zeros(members))


def credit(posterior: Posterior, member: jax.Array, episode_return: jax.Array, counts: jax.Array) -> Posterior:
    """Adds an episode's return to its member where `counts` (equation 19 sums over all past episodes).

    Compensated (Kahan) addition: after hundreds of episodes of thousands, plain float32 sums would be off by more
    than the 1e-5 to which the probabilities can be recomputed from the log.
    """
    gain = jnp.where(counts, episode_return, 0.0) * jax.nn.one_hot(member, posterior.returns.shape[0])
    gain = gain - posterior.compensation
    total = posterior.returns + gain
    return Posterior(returns=total, compensation=(total - posterior.returns) - gain)


def logits(posterior: Posterior, temperature: jax.Array) -> jax.Array:
    """[N·M] accumulated return / τ (equation 19). τ = ∞ gives the uniform distribution of equation 18."""
    centred = posterior.returns - jnp.max(posterior.returns)  # before dividing: keeps small differences exact
    return (centred - posterior.compensation) / temperature


def best(posterior: Posterior) -> jax.Array:
    """The member that has earned the most, [] int, whatever the temperature."""
    return jnp.argmax(logits(posterior, jnp.float32(1.0)))


def draw(posterior: Posterior, temperature: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A member, [] int, and the distribution [N·M] that it was drawn from."""
    scores = logits(posterior, temperature)
    return jax.random.categorical(key, scores), jax.nn.softmax(scores)


def exploration_probability(forced_exploration: jax.Array, episode: jax.Array) -> jax.Array:
    """min(1, τ / k): with it episode k, from 1, takes random actions (equation 33)."""
    return jnp.minimum(1.0, forced_exploration / episode)
