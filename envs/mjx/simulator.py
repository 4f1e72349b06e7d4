"""One simulator step of an MJX model, as C MuJoCo takes it and compiled once.

Two things differ from `mjx.step`. MJX unrolls the four stages of its Runge–Kutta integrator, so that a program holds
four copies of the whole dynamics and takes about twice as long to compile; here the stages are a loop around
`forward`, with the same arithmetic and the same order of the sums. And `forward` gives contacts the tangents that C
MuJoCo gives them (see `contacts`).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from mujoco import mjx

from vecpsmbpo.envs.mjx import contacts

# The tableau of classic Runge–Kutta: where each stage is evaluated, and what it weighs.
STAGE_OFFSET = np.array([0.0, 0.5, 0.5, 1.0], np.float32)
STAGE_WEIGHT = np.array([1 / 6, 1 / 3, 1 / 3, 1 / 6], np.float32)

# Enough iterations of the solver's line search for the ported tasks. MuJoCo's own 50 would be a loop of 50, converged
# or not, since under `vmap` MJX's conditional executes both branches. On 300 to 500 states of ant, hopper and walker2d,
# 4 and more gave the same float32 numbers as 50 to the bit; the step is about three times as fast. The parity tests
# compare what comes of it with C MuJoCo, which keeps its 50.
LINE_SEARCH_ITERATIONS = 8


class Physics(struct.PyTreeNode):
    """All that the simulator needs to go on: what lies between two control steps.

    The rest of `mjx.Data` is a function of it, and is recomputed by the step. This keeps the state of an environment
    to a few dozen floats: a reset inside a scan is a cheap select, and a checkpoint does not depend on MJX's layout.

    Attributes:
        qpos: [nq].
        qvel: [nv].
        warmstart: [nv], the solver's starting point (`qacc_warmstart`).
        seen: [nq], the positions that body frames were last computed from. C MuJoCo leaves its frames there after a
            step, one stage behind qpos, and some tasks' rewards read them.
    """

    qpos: jax.Array
    qvel: jax.Array
    warmstart: jax.Array
    seen: jax.Array


class Simulator:
    """Steps one MuJoCo model on MJX.

    Raises:
        NotImplementedError: the model needs something that MJX lacks.
    """

    def __init__(self, model: mujoco.MjModel, line_search_iterations: int | None = None):
        """`line_search_iterations`: at most so many; None: as many as the model says."""
        if model.na:
            raise NotImplementedError("actuators with activations have state that `Physics` does not keep")
        here = jax.local_devices()[0]  # by itself MJX takes the first of all, which may be another process's
        self._model = mjx.put_model(model, impl="jax", device=here)
        if line_search_iterations is not None:
            fewer = min(model.opt.ls_iterations, line_search_iterations)
            self._model = self._model.replace(opt=self._model.opt.replace(ls_iterations=fewer))
        self._blank = mjx.make_data(model, impl="jax", device=here)
        self._contact_frames = contacts.frames_of_c(model)
        self._integrate_positions = positions_integrator(model)
        self._is_runge_kutta = model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        self._timestep = model.opt.timestep

    def at_rest(self, qpos: jax.Array, qvel: jax.Array) -> Physics:
        """The state at qpos [nq], qvel [nv], with a cold solver."""
        return Physics(qpos, qvel, warmstart=jnp.zeros_like(qvel), seen=qpos)

    def step(self, physics: Physics, control: jax.Array) -> Physics:
        """One step of the model's timestep. control: [nu]."""
        data = self._blank.replace(qpos=physics.qpos, qvel=physics.qvel, qacc_warmstart=physics.warmstart, ctrl=control)
        if self._is_runge_kutta:
            return self._runge_kutta(data)
        integrate = mjx.implicit if self._model.opt.integrator == mjx.IntegratorType.IMPLICITFAST else mjx.euler
        after = integrate(self._model, self.forward(data))
        return Physics(after.qpos, after.qvel, after.qacc_warmstart, seen=data.qpos)

    def forward(self, data: Any) -> Any:
        """`mjx.forward` (without sensors) with C MuJoCo's contact frames: data with qacc."""
        model = self._model
        for stage in (mjx.kinematics, mjx.com_pos, mjx.tendon, mjx.crb, mjx.tendon_armature, mjx.factor_m):
            data = stage(model, data)
        data = self._contact_frames(mjx.collision(model, data))
        for stage in (mjx.make_constraint, mjx.transmission):
            data = stage(model, data)
        for stage in (mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
            data = stage(model, data)
        if data._impl.efc_J.size == 0:
            return data.replace(qacc=data.qacc_smooth)
        return mjx.solve(model, data)

    def _runge_kutta(self, data: Any) -> Physics:
        step = self._timestep

        def stage(carry, tableau):
            velocity, acceleration, velocity_sum, acceleration_sum, _ = carry
            offset, weight = tableau
            qpos = self._integrate_positions(data.qpos, velocity, step * offset)
            here = data.replace(qpos=qpos, qvel=data.qvel + step * offset * acceleration)
            qacc = self.forward(here).qacc
            velocity_sum = velocity_sum + weight * here.qvel
            return (here.qvel, qacc, velocity_sum, acceleration_sum + weight * qacc, qpos), None

        zero = jnp.zeros_like(data.qvel)
        carry, _ = jax.lax.scan(stage, (zero, zero, zero, zero, data.qpos), (STAGE_OFFSET, STAGE_WEIGHT))
        _, last_acceleration, velocity, acceleration, seen = carry
        return Physics(
            qpos=self._integrate_positions(data.qpos, velocity, step),
            qvel=data.qvel + step * acceleration,
            # MuJoCo starts the next step's solver from the last stage's acceleration.
            warmstart=last_acceleration,
            seen=seen,
        )


def positions_integrator(model: mujoco.MjModel) -> Callable[[jax.Array, jax.Array, Any], jax.Array]:
    """(qpos [nq], qvel [nv], seconds) -> qpos [nq] after moving with a constant velocity, quaternions turned."""
    # Addresses of: positions that add their velocity, quaternions, and their velocities.
    linear: list[tuple[int, int]] = []
    turning: list[tuple[int, int]] = []
    for kind, position, velocity in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            linear += [(position + axis, velocity + axis) for axis in range(3)]
            turning.append((position + 3, velocity + 3))
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            turning.append((position, velocity))
        else:
            linear.append((position, velocity))
    to, by = np.array(linear).reshape(-1, 2).T

    def integrate(qpos, qvel, seconds):
        qpos = qpos.at[to].add(seconds * qvel[by]) if turning else qpos + seconds * qvel
        for position, velocity in turning:
            turned = _turn(qpos[position : position + 4], seconds * qvel[velocity : velocity + 3])
            qpos = qpos.at[position : position + 4].set(turned)
        return qpos

    return integrate


def _turn(quaternion: jax.Array, rotation: jax.Array) -> jax.Array:
    """A quaternion (w, x, y, z) times the rotation by a vector in its own frame, normalized."""
    angle = jnp.linalg.norm(rotation)
    axis = rotation / jnp.where(angle == 0, 1.0, angle)
    scalar, vector = quaternion[0], quaternion[1:]
    cosine, sine = jnp.cos(angle / 2), jnp.sin(angle / 2) * axis
    turned = jnp.concatenate(
        [
            (scalar * cosine - jnp.dot(vector, sine))[None],
            scalar * sine + cosine * vector + jnp.cross(vector, sine),
        ]
    )
    return turned / jnp.linalg.norm(turned)
