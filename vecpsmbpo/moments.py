"""Running moments of D_E (Welford), by which models are put into units (equation 20)."""

import jax.numpy as jnp

from vecpsmbpo.types import Moments, Transition, Whole


def init(obs_size: int, action_size: int) -> Moments:
    """Of no rows."""
    inputs, zero = obs_size + action_size, jnp.zeros(())
    zeros = jnp.zeros(inputs + obs_size + 1)
    return Moments(zeros, zeros, lowest_reward=zero, highest_reward=zero, inputs=inputs)


def add(moments: Moments, transition: Transition, added: Whole) -> Moments:
    """Of one more row, after `added` of them. Leaves of the transition: [O], [A], []."""
    obs, action, reward, next_obs, _ = transition
    value = jnp.concatenate([obs, action, next_obs - obs, reward[None]])
    change = value - moments.mean
    mean = moments.mean + change / (added + 1)
    return moments.replace(
        mean=mean,
        deviation=moments.deviation + change * (value - mean),
        lowest_reward=jnp.minimum(moments.lowest_reward, reward),
        highest_reward=jnp.maximum(moments.highest_reward, reward),
    )
