"""The contact tangents of C MuJoCo, for MJX.

Between a plane and a capsule, C MuJoCo's first tangent is the capsule's axis projected on the plane. MJX 3.16 does the
same, but for capsules steeper than 60° it takes a fixed direction instead. With pyramidal friction cones the tangents
matter: ant's velocities after one control step were off by up to 1. This is the one place that depends on
MJX's private layout of contacts (`data._impl.contact`); tests/test_simulator.py fails when it changes.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np


def frames_of_c(model: mujoco.MjModel) -> Callable[[Any], Any]:
    """A function of `mjx.Data` after its collision pass that gives it C MuJoCo's contact frames."""
    kinds = np.asarray(model.geom_type)
    planes, capsules = kinds == mujoco.mjtGeom.mjGEOM_PLANE, kinds == mujoco.mjtGeom.mjGEOM_CAPSULE
    if not (planes.any() and capsules.any()):
        return lambda data: data
    planes, capsules = jnp.asarray(planes), jnp.asarray(capsules)

    def corrected(data: Any) -> Any:
        contact = data._impl.contact
        first, second = contact.geom[:, 0], contact.geom[:, 1]
        axis = data.geom_xmat[second].reshape(-1, 3, 3)[:, :, 2]
        frame = jax.vmap(_aligned)(contact.frame, axis)
        concerned = planes[first] & capsules[second]
        frame = jnp.where(concerned[:, None, None], frame, contact.frame)
        return data.tree_replace({"_impl.contact.frame": frame})

    return corrected


def _aligned(frame: jax.Array, axis: jax.Array) -> jax.Array:
    """Rows (normal, tangents) [3, 3] -> with the first tangent along the projection of `axis` [3]."""
    normal = frame[0]
    tangent = axis - normal * jnp.dot(normal, axis)
    length = jnp.linalg.norm(tangent)
    # Upright to the last bit: any direction does, as in C.
    tangent = jnp.where(length > 0, tangent / jnp.where(length > 0, length, 1.0), frame[1])
    return jnp.stack([normal, tangent, jnp.cross(normal, tangent)])
