"""The MJX step against C MuJoCo where MJX's own differs: contact tangents, quaternions; and what a task makes of it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from vecpsmbpo.envs.mjx import contacts, simulator
from vecpsmbpo.envs.mjx.base import MjxEnv
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec

CAPSULE = """
<mujoco><option cone="pyramidal"/><worldbody>
  <geom type="plane" size="5 5 1"/>
  <body pos="0 0 1"><freejoint/><geom type="capsule" size="0.1 0.3" friction="1 .1 .1"/></body>
</worldbody></mujoco>
"""
SPINNER = """
<mujoco><option integrator="{integrator}" timestep="0.01"/><worldbody>
  <body pos="0 0 2"><freejoint/><geom type="box" size="0.1 0.2 0.3"/>
    <body pos="0 0 0.4"><joint type="ball"/><geom type="box" size="0.05 0.1 0.15"/>
      <body pos="0 0 0.3"><joint type="hinge" axis="0 1 0" damping="0.1"/><geom type="sphere" size="0.1"/></body>
    </body>
  </body>
</worldbody></mujoco>
"""


def test_contact_frames_are_those_of_c_mujoco():
    model = mujoco.MjModel.from_xml_string(CAPSULE)
    data, ported, blank = mujoco.MjData(model), mjx.put_model(model, impl="jax"), mjx.make_data(model, impl="jax")
    correct = contacts.frames_of_c(model)

    @jax.jit
    def contact_and_frame(qpos):
        collided = mjx.collision(ported, mjx.kinematics(ported, blank.replace(qpos=qpos)))
        contact = collided._impl.contact
        return contact.dist, contact.frame, correct(collided)._impl.contact.frame

    for tilt in (0.0, 20.0, 45.0, 59.0, 61.0, 85.0):  # degrees from upright; MJX alone departs from C below 30
        data.qpos[2] = 0.1 + 0.3 * np.cos(np.deg2rad(tilt)) - 0.002
        mujoco.mju_axisAngle2Quat(data.qpos[3:], np.array([0.6, 0.8, 0.0]), np.deg2rad(tilt))
        mujoco.mj_forward(model, data)
        distance, plain, corrected = contact_and_frame(jnp.asarray(data.qpos, jnp.float32))
        touching = np.flatnonzero(np.asarray(distance) < 0)
        assert len(touching) == data.ncon >= 1
        numbers = 3 if tilt == 0 else 9  # upright, any tangent will do
        for ours, theirs in zip(touching, data.contact.frame, strict=True):
            np.testing.assert_allclose(np.ravel(corrected[ours])[:numbers], theirs[:numbers], atol=2e-6)
        if tilt == 20:  # should this fail, MJX has mended its frames and `contacts` can go
            assert np.abs(np.ravel(plain[touching[0]]) - data.contact.frame[0]).max() > 0.01


@pytest.mark.parametrize("integrator", ["RK4", "Euler", "implicitfast"])
def test_free_ball_and_hinge_joints_turn_as_in_c_mujoco(integrator):
    model = mujoco.MjModel.from_xml_string(SPINNER.format(integrator=integrator))
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    data.qvel = random.normal(size=model.nv) * 3
    data.qpos[3:7] = [0.5, 0.5, -0.5, 0.5]
    ours = simulator.Simulator(model)
    physics = ours.at_rest(jnp.asarray(data.qpos, jnp.float32), jnp.asarray(data.qvel, jnp.float32))
    step = jax.jit(ours.step)
    for _ in range(20):
        mujoco.mj_step(model, data)
        physics = step(physics, jnp.zeros(0))
    np.testing.assert_allclose(physics.qpos, data.qpos, atol=1e-4)
    np.testing.assert_allclose(physics.qvel, data.qvel, atol=5e-4)
    # C MuJoCo's body frames lag behind its positions, by a step or (Runge–Kutta) a stage; `seen` is where.
    np.testing.assert_allclose(physics.seen[:3], data.xpos[1], atol=1e-4)
    assert (np.abs(data.xpos[1] - data.qpos[:3]).max() > 1e-3) == (integrator != "RK4")


def test_models_with_activations_are_refused():
    xml = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
      <actuator><general joint="j" dyntype="integrator"/></actuator></mujoco>"""
    with pytest.raises(NotImplementedError, match="activations"):
        simulator.Simulator(mujoco.MjModel.from_xml_string(xml))


SLIDER = """
<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-1 1"/></actuator></mujoco>
"""


class Slider(MjxEnv):
    """Moves along x; ends where the action pushes away from the origin, which the new observation does not tell."""

    spec = EnvSpec("slider", 1, 1, 10, lambda obs, action, next_obs: obs[..., 0] * action[..., 0] > 0)

    def __init__(self, xml=SLIDER):
        super().__init__(mujoco.MjModel.from_xml_string(xml), substeps=2)

    def initial_state(self, key):
        return jnp.ones(1), jnp.zeros(1)

    def observe(self, physics):
        return physics.qpos

    def reward(self, before, action, after):
        return after.qpos[0]


def test_a_rule_of_termination_gets_the_state_before_the_action_and_the_state_after():
    env = Slider()
    state = env.reset(jax.random.key(0))
    step = jax.jit(env.step)
    assert [float(step(state, jnp.array([a])).done) for a in (-1.0, 1.0)] == [0, 1]


def test_an_actuator_without_a_range_is_an_error():
    """MuJoCo gives it one of 0 to 0, to which every action would be scaled."""
    with pytest.raises(SettingError, match="actuator 0: its model gives it no ctrlrange"):
        Slider(SLIDER.replace(' ctrlrange="-1 1"', ""))


def test_tasks_keep_their_model_s_line_search_unless_they_say_otherwise():
    """A task of one's own is not a ported one, on which fewer iterations were seen to suffice."""
    assert Slider()._simulator._model.opt.ls_iterations == mujoco.MjModel.from_xml_string(SLIDER).opt.ls_iterations
