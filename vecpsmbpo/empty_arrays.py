"""Arrays without elements, as jax 0.11 can take them into a program of several devices."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun


def made_inside(function: Callable) -> Callable:
    """`function`, but it makes the arrays without elements itself that it is given or closes over.

    An MJX model is full of them: there is one for every kind of joint, tendon and contact that it has not. The compiler
    of jax 0.11 crashes where the body of a `shard_map` reads one that comes from outside (docs/architecture.md).
    """

    def made_here(x: Any) -> Any:
        return x if x.size else jnp.zeros_like(x)

    def body(*args: Any) -> Any:
        args = jax.tree.map(made_here, args)
        traced, result = jax.make_jaxpr(function, return_shape=True)(*args)
        traced = ClosedJaxpr(traced.jaxpr, [made_here(x) for x in traced.consts])
        return jax.tree.unflatten(jax.tree.structure(result), jaxpr_as_fun(traced)(*jax.tree.leaves(args)))

    return body
