"""What every measurement is made with."""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vecpsmbpo.networks import PRECISIONS


def best_seconds(run: Callable[[], Any], repeats: int) -> float:
    """The shortest of several runs: what the machine can do when nothing disturbs it."""
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def matmul_peak(precision: str = "default", size: int = 2048, repeats: int = 5) -> float:
    """FLOP/s of a large matrix product on every device at once.

    Args:
        precision: `network_precision` of what is compared to it.
    """
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
    spec = jax.sharding.PartitionSpec("devices")
    dtype, products = PRECISIONS[precision]
    squares = jnp.ones((mesh.size, size, size), dtype)
    operands = jax.device_put(squares, jax.sharding.NamedSharding(mesh, spec))

    def multiply(x: jax.Array) -> jax.Array:
        return jnp.matmul(x, x, precision=products, preferred_element_type=jnp.float32)

    product = jax.jit(jax.shard_map(multiply, mesh=mesh, in_specs=spec, out_specs=spec))
    jax.block_until_ready(product(operands))
    return mesh.size * 2 * size**3 / best_seconds(lambda: product(operands), repeats)
