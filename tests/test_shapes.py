"""That what signatures say of shapes is indeed checked in these tests."""

import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from tests import shapes
from vecpsmbpo import networks, sac
from vecpsmbpo.algorithms.base import Algorithm


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


def test_every_module_that_says_shapes_is_found():
    """A search that finds fewer would check fewer, in silence."""
    core = "sac networks dynamics replay posterior mixing imagination health"
    algorithms = "base ps_mbpo.algorithm slbo.trpo slbo.multistep slbo.algorithm pets.planning"
    least = {*core.split(), *(f"algorithms.{name}" for name in algorithms.split())}
    assert {name.removeprefix("vecpsmbpo.") for name in shapes.core()} >= least
    with pytest.raises(TypeCheckError, match="enabled"):
        Algorithm.credit(None, None, jnp.zeros(()), jnp.zeros(3, bool))
