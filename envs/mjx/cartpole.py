"""dm_control cartpole, `swingup` and `swingup_sparse`, on MJX."""

import jax
import jax.numpy as jnp
import mujoco
from dm_control.suite import cartpole

from vecpsmbpo.envs import specs
from vecpsmbpo.envs.mjx.base import MjxEnv
from vecpsmbpo.envs.mjx.simulator import LINE_SEARCH_ITERATIONS, Physics
from vecpsmbpo.envs.mjx.tolerance import tolerance

CART_RANGE = (-0.25, 0.25)
ANGLE_COSINE_RANGE = (0.995, 1.0)


class CartpoleSwingup(MjxEnv):
    """Swing the pole up and balance it in the middle; smooth reward in [0, 1].

    qpos = (cart position in m, pole angle in rad, 0 upright); qvel their rates.
    """

    spec = specs.get("cartpole_swingup")

    def __init__(self):
        xml, assets = cartpole.get_model_and_assets()
        model = mujoco.MjModel.from_xml_string(xml, assets)
        model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)  # a read-out that MJX refuses
        super().__init__(model, substeps=1, line_search_iterations=LINE_SEARCH_ITERATIONS)

    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        position_key, velocity_key = jax.random.split(key)
        hanging = jnp.array([0.0, jnp.pi])
        qpos = hanging + 0.01 * jax.random.normal(position_key, (2,))
        return qpos, 0.01 * jax.random.normal(velocity_key, (2,))

    def observe(self, physics: Physics) -> jax.Array:
        position, angle = physics.qpos
        return jnp.array([position, jnp.cos(angle), jnp.sin(angle), *physics.qvel])

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        position, angle = after.qpos
        upright = (jnp.cos(angle) + 1) / 2
        centered = (1 + tolerance(position, margin=2.0)) / 2
        small_control = (4 + tolerance(action[0], margin=1.0, value_at_margin=0.0, sigmoid="quadratic")) / 5
        small_velocity = (1 + tolerance(after.qvel[1], margin=5.0)) / 2
        return upright * small_control * small_velocity * centered


class CartpoleSwingupSparse(CartpoleSwingup):
    """The same, with reward 1 only while the pole is upright and the cart in the middle."""

    spec = specs.get("cartpole_swingup_sparse")

    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        position, angle = after.qpos
        return tolerance(position, CART_RANGE) * tolerance(jnp.cos(angle), ANGLE_COSINE_RANGE)
