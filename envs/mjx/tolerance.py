"""The control suite's reward shape (dm_control.utils.rewards.tolerance) in jax.numpy."""

import jax
import jax.numpy as jnp


def tolerance(
    x: jax.Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    margin: float = 0.0,
    value_at_margin: float = 0.1,
    sigmoid: str = "gaussian",
) -> jax.Array:
    """1 within `bounds`; outside, falling to `value_at_margin` at distance `margin`, or 0 at once without a margin.

    `sigmoid` is `gaussian` or `quadratic`, the two that the suite's ported tasks use.
    """
    low, high = bounds
    inside = (low <= x) & (x <= high)
    if margin == 0:
        return jnp.where(inside, 1.0, 0.0)
    distance = jnp.where(x < low, low - x, x - high) / margin
    if sigmoid == "gaussian":
        outside = jnp.exp(-0.5 * distance**2 * (-2 * jnp.log(value_at_margin)))
    else:
        scaled = distance * jnp.sqrt(1 - value_at_margin)
        outside = jnp.where(jnp.abs(scaled) < 1, 1 - scaled**2, 0.0)
    return jnp.where(inside, 1.0, outside)
