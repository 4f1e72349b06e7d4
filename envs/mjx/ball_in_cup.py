"""dm_control ball_in_cup, `catch`, on MJX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from dm_control.suite import ball_in_cup

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.base import MjxEnv
from vecpsmbpo.envs.mjx.simulator import LINE_SEARCH_ITERATIONS, Physics

CONTROL_TIMESTEP = 0.02
RESET_X, RESET_Z = (-0.2, 0.2), (0.2, 0.5)


class BallInCup(MjxEnv):
    """Swing a ball on a string up into a cup; reward 1 while it is inside, else 0.

    All joints slide: qpos = (cup x, cup z, ball x, ball z) in m from their bodies' rest positions.
    """

    spec = specs.get("ball_in_cup")

    def __init__(self):
        xml, assets = ball_in_cup.get_model_and_assets()
        model = mujoco.MjModel.from_xml_string(xml, assets)
        substeps = round(CONTROL_TIMESTEP / model.opt.timestep)
        super().__init__(model, substeps, line_search_iterations=LINE_SEARCH_ITERATIONS)
        self._ball_rest = model.body("ball").pos[[0, 2]]
        self._target_rest = (model.body("cup").pos + model.site("target").pos)[[0, 2]]
        self._reach = model.site("target").size[[0, 2]] - model.geom("ball").size[0]
        self._cup_parts = _capsules(model, "cup")
        self._ball_radius = model.geom("ball").size[0]
        self._ground = model.geom("ground").pos[2]

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The ball uniform in a box, redrawn until it touches nothing; all else at rest."""

        def draw(carry):
            key, _ = carry
            key, x_key, z_key = jax.random.split(key, 3)
            x = jax.random.uniform(x_key, minval=RESET_X[0], maxval=RESET_X[1])
            z = jax.random.uniform(z_key, minval=RESET_Z[0], maxval=RESET_Z[1])
            return key, jnp.array([x, z])

        _, ball = jax.lax.while_loop(lambda carry: self._touches(carry[1]), draw, draw((key, jnp.zeros(2))))
        return jnp.concatenate([jnp.zeros(2), ball]), jnp.zeros(4)

    def observe(self, physics: Physics) -> jax.Array:
        return jnp.concatenate([physics.qpos, physics.qvel])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        target = after.qpos[:2] + self._target_rest
        ball = after.qpos[2:] + self._ball_rest
        return jnp.all(jnp.abs(target - ball) < self._reach).astype(jnp.float32)

    def _touches(self, ball: jax.Array) -> jax.Array:
        """Whether the ball at displacement [2] touches the resting cup or the ground.

        In closed form, as the distance of a point from segments in the plane: a collision pass of the simulator
        would cost as much as a step, and this runs inside the scan.
        """
        start, end, radius = self._cup_parts
        along = end - start
        offset = ball + self._ball_rest - start
        fraction = jnp.clip(jnp.sum(offset * along, axis=1) / jnp.sum(along**2, axis=1), 0.0, 1.0)
        gap = jnp.linalg.norm(offset - fraction[:, None] * along, axis=1) - radius
        height = ball[1] + self._ball_rest[1] - self._ground
        return jnp.any(gap <= self._ball_radius) | (height <= self._ball_radius)


def _capsules(model: mujoco.MjModel, body: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The capsules of a body at rest, in the x-z plane: both ends [n, 2] and radius [n]."""
    starts, ends, radii = [], [], []
    for index in range(model.ngeom):
        geom = model.geom(index)
        if geom.bodyid[0] != model.body(body).id:
            continue
        axis = np.zeros(3)
        mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, geom.size[1]]), geom.quat)
        center = model.body(body).pos + geom.pos
        starts.append((center - axis)[[0, 2]])
        ends.append((center + axis)[[0, 2]])
        radii.append(geom.size[0])
    return np.array(starts), np.array(ends), np.array(radii)
