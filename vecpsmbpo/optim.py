"""Adam with a traced learning rate."""

from typing import Any

import jax
import optax

from vecpsmbpo.types import Params

_adam = optax.scale_by_adam()
init = _adam.init


def with_decay(decay: jax.Array, gradient: jax.Array, param: jax.Array) -> jax.Array:
    """L2 in the gradient, as torch's Adam(weight_decay) of both MBPO codebases has it."""
    return gradient + decay * param


def step(gradient: Params, optimizer: Any, params: Params, rate: jax.Array | float) -> tuple[Params, Any]:
    """The parameters one Adam step further, and the optimizer's new state."""
    direction, optimizer = _adam.update(gradient, optimizer)
    return jax.tree.map(lambda p, d: p - rate * d, params, direction), optimizer
