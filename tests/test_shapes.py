"""That what signatures say of shapes is indeed checked in these tests."""

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from vecpsmbpo import networks, sac


def test_a_function_refuses_axes_that_do_not_fit():
    ones, zeros = jnp.ones(3), jnp.zeros(3)
    sac.target_value(ones, zeros, ones, ones, 0.1, 0.99)
    with pytest.raises(TypeCheckError, match="terminated"):
        sac.target_value(ones, jnp.zeros(4), ones, ones, 0.1, 0.99)


def test_a_method_refuses_a_batch_that_is_not_that_of_its_other_arguments(key):
    critic = networks.TwinCritic(4, 1)
    params = critic.init(key, jnp.zeros(2), jnp.zeros(1))
    with pytest.raises(TypeCheckError, match="action"):
        critic.values(params, jnp.zeros((5, 2)), jnp.zeros((6, 1)))
