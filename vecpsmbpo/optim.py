"""Adam with a traced learning rate."""

from typing import Any

import jax
import optax

from vecpsmbpo.types import Number, Params

_adam = optax.scale_by_adam()
init = _adam.init


def step(
    gradient: Params, optimizer: Any, params: Params, rate: Number, *, decay: Number | None = None
) -> tuple[Params, Any]:
    """The parameters one Adam step further, and the optimizer's new state.

    Args:
        decay: of the parameters, as L2 in the gradient: torch's Adam(weight_decay) of both MBPO codebases has it so.
    """
    if decay is not None:
        gradient = optax.tree.add_scale(gradient, decay, params)
    direction, optimizer = _adam.update(gradient, optimizer)
    return jax.tree.map(lambda p, d: p - rate * d, params, direction), optimizer
