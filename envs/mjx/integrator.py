"""One simulator step of an MJX model, compiled once.

MJX unrolls the four stages of its Runge–Kutta integrator, so that a program holds four copies of the whole dynamics
and takes about three times as long to compile. Here the stages are a loop around `mjx.forward`; the arithmetic is the
same, and so is the order of the sums.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

# The tableau of classic Runge–Kutta: where each stage is evaluated, and what it weighs.
STAGE_OFFSET = np.array([0.0, 0.5, 0.5, 1.0], np.float32)
STAGE_WEIGHT = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6], np.float32)


def loops_over_stages(model: mujoco.MjModel) -> bool:
    """Whether `runge_kutta` below covers the model: RK4, joints whose position adds its velocity, no activations."""
    adds = np.isin(model.jnt_type, [mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE]).all()
    return model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4 and bool(adds) and model.na == 0


def runge_kutta(model: Any, data: Any) -> Any:
    """`mjx.step` for the models of `loops_over_stages`; gives `data` with qpos, qvel and qacc_warmstart advanced."""
    step = model.opt.timestep

    def stage(carry, tableau):
        velocity, acceleration, velocity_sum, acceleration_sum = carry
        offset, weight = tableau
        here = data.replace(qpos=data.qpos + step * offset * velocity, qvel=data.qvel + step * offset * acceleration)
        qacc = mjx.forward(model, here).qacc
        velocity_sum = velocity_sum + weight * here.qvel
        return (here.qvel, qacc, velocity_sum, acceleration_sum + weight * qacc), None

    zero = jnp.zeros_like(data.qvel)
    carry, _ = jax.lax.scan(stage, (zero, zero, zero, zero), (STAGE_OFFSET, STAGE_WEIGHT))
    _, last_acceleration, velocity, acceleration = carry
    return data.replace(
        qpos=data.qpos + step * velocity,
        qvel=data.qvel + step * acceleration,
        # MuJoCo starts the next step's solver from the last stage's acceleration.
        qacc_warmstart=last_acceleration,
    )
