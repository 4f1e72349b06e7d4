"""SLBO's networks: TRPO's policy and value function."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, PRNGKeyArray

from vecpsmbpo.types import Params


class TanhMLP(nn.Module):
    """Dense layers with tanh between them, and a linear output that begins near 0. Products are float32 on every
    device, whatever `network_precision`: conjugate gradients need the bits."""

    output_size: int
    hidden_size: int
    hidden_layers: int

    @nn.compact
    def __call__(self, hidden: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        dense = partial(nn.Dense, precision=jax.lax.Precision.HIGHEST)
        for _ in range(self.hidden_layers):
            hidden = nn.tanh(dense(self.hidden_size, kernel_init=nn.initializers.orthogonal(2**0.5))(hidden))
        return dense(self.output_size, kernel_init=nn.initializers.orthogonal(0.01))(hidden)


class Normal(NamedTuple):
    """Independent normals per action; loc and log_std [..., A]."""

    loc: jax.Array
    log_std: jax.Array

    def sample(self, key: PRNGKeyArray) -> Float[Array, "*batch A"]:
        return self.loc + jnp.exp(self.log_std) * jax.random.normal(key, self.loc.shape)

    def log_prob(self, action: Float[Array, "*batch A"]) -> Float[Array, "*batch"]:
        scaled = (action - self.loc) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * scaled**2 - self.log_std - 0.5 * jnp.log(2 * jnp.pi), axis=-1)

    def entropy(self) -> Float[Array, "*batch"]:
        return jnp.sum(jnp.broadcast_to(self.log_std, self.loc.shape) + 0.5 * jnp.log(2 * jnp.pi * jnp.e), axis=-1)

    def divergence_to(self, other: "Normal") -> Float[Array, "*batch"]:
        """KL(self || other)."""
        ratio = jnp.exp(2 * (self.log_std - other.log_std))
        distance = ((self.loc - other.loc) * jnp.exp(-other.log_std)) ** 2
        return 0.5 * jnp.sum(ratio + distance - 1 - 2 * (self.log_std - other.log_std), axis=-1)


class GaussianPolicy(nn.Module):
    """π(a | s), normal with a standard deviation that does not depend on the state; actions are clipped to be taken."""

    action_size: int
    hidden_size: int
    hidden_layers: int

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Normal:
        """The distribution of actions."""
        loc = TanhMLP(self.action_size, self.hidden_size, self.hidden_layers)(obs)
        log_std = self.param("log_std", nn.initializers.constant(-0.5), (self.action_size,))
        return Normal(loc, jnp.broadcast_to(log_std, loc.shape))

    def distribution(self, params: Params, obs: Float[Array, "*batch O"]) -> Normal:
        """π(· | obs) of these parameters."""
        distribution: Any = self.apply(params, obs)
        return distribution


class StateValue(nn.Module):
    """V(s)."""

    hidden_size: int
    hidden_layers: int

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> Float[Array, "*batch"]:
        return TanhMLP(1, self.hidden_size, self.hidden_layers)(obs)[..., 0]

    def values(self, params: Params, obs: Float[Array, "*batch O"]) -> Float[Array, "*batch"]:
        """V of these parameters."""
        values: Any = self.apply(params, obs)
        return values
