"""The tasks against their originals: Gymnasium and dm_control."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers import assert_resumes_exactly
from tools import parity
from vecpsmbpo import envs
from vecpsmbpo.envs import registry, specs
from vecpsmbpo.settings import SettingError


@pytest.fixture(scope="module", params=registry.names("mjx"))
def port(request):
    """The MJX port with its compiled functions."""
    return parity.Port(request.param)


def test_one_control_step_is_that_of_the_original(port):
    """From the same simulator state, over random actions: observation, reward and termination. `tools/parity.py` does
    the same with thousands of states."""
    name = port.env.spec.name
    steps = parity.collect(name, parity.uniform(1, port.env.action_size), states=150, seed=3)
    found = parity.compare_steps(port, steps)
    assert found["obs_p50"] < 1e-4
    assert found["obs_p99"] < 1e-3
    assert found["reward_max"] < 1e-3
    assert found["terminated_agree"] == 1
    assert found["terminations"] > 0 or name not in ("hopper", "walker2d")
    assert found["terminations"] == 0 or name in ("ant", "hopper", "walker2d")
    assert (found["in_contact"] > 0) == (name not in ("cartpole_swingup", "cartpole_swingup_sparse"))


def test_sizes_are_those_of_the_registry(port):
    spec, task = port.env.spec, registry.TASKS[port.env.spec.name]
    host = envs.make(spec.name, "host")
    state = port.env.reset(jax.random.key(0))
    assert state.obs.shape == (task.sizes.obs_size,) == host.reset().shape[1:]
    assert port.env.action_size == task.sizes.action_size
    assert spec.episode_length == host.episode_length == task.sizes.episode_length


def test_resets_are_distributed_as_the_original_s(port):
    assert parity.compare_resets(port, port.env.spec.name, 300) > 1e-5


def test_ball_in_cup_rewards_the_ball_in_the_cup():
    """The reward at states placed by hand, against dm_control's own."""
    env = envs.make("ball_in_cup", "mjx")
    physics = envs.make("ball_in_cup", "host").simulators[0].env.physics
    inside = 0
    for x, z in np.random.default_rng(1).uniform([-0.05, 0.25], [0.05, 0.45], (200, 2)):
        with physics.reset_context():
            physics.data.qpos[:] = [0, 0, x, z]
        ours = env.reward(None, None, env.state_at(jnp.array([0, 0, x, z]), jnp.zeros(4)).pipeline_state)
        assert float(ours) == physics.in_target()
        inside += physics.in_target()
    assert 20 < inside < 180  # both happened


def test_sparse_cartpole_rewards_balance():
    env = envs.make("cartpole_swingup_sparse", "mjx")
    physics = envs.make("cartpole_swingup_sparse", "host").simulators[0].env.physics
    task = envs.make("cartpole_swingup_sparse", "host").simulators[0].env.task
    for qpos in ([0.0, 0.0], [0.0, 0.09], [0.0, 0.11], [0.24, 0.0], [0.26, 0.0], [0.0, np.pi]):
        with physics.reset_context():
            physics.data.qpos[:] = qpos
        ours = env.reward(None, None, env.state_at(jnp.array(qpos), jnp.zeros(2)).pipeline_state)
        assert float(ours) == task.get_reward(physics)


@pytest.mark.parametrize(
    ("z", "angle", "joint", "ends"),
    [
        (1.2, 0.0, 0.0, False),
        (0.69, 0.0, 0.0, True),
        (1.2, 0.21, 0.0, True),
        (1.2, -0.21, 0.0, True),
        (1.2, 0.0, 101.0, True),
        (1.2, 0.0, np.nan, True),
        (np.nan, 0.0, 0.0, True),
        (np.inf, 0.0, 0.0, True),
    ],
)
def test_hopper_s_termination_rule(z, angle, joint, ends):
    obs = jnp.zeros(11).at[:3].set(jnp.array([z, angle, joint]))
    assert bool(specs.get("hopper").terminated(obs, None, obs)) == ends


@pytest.mark.parametrize("name", registry.names("host"))
def test_host_environments_resume_exactly(name):
    env, other = (envs.make(name, "host", num_envs=2, seed=seed) for seed in (3, 99))
    assert_resumes_exactly(env, other, 40)


@pytest.mark.parametrize("name", registry.names("host"))
def test_host_environments_keep_the_true_successor(name):
    env = envs.make(name, "host", num_envs=2, seed=0)
    env.episode_length = 5
    env.reset()
    for _ in range(5):
        step = env.step(np.ones((2, env.spec.action_size)))
    assert step.truncated.all()
    assert not step.terminated.any()
    assert (step.next_obs != step.obs).any(axis=1).all()


def test_mistakes_are_named():
    with pytest.raises(SettingError, match="must be one of ant"):
        envs.make("hoper")
    with pytest.raises(SettingError, match="backend=gpu: must be auto or mjx or host"):
        envs.make("hopper", "gpu")
    with pytest.raises(ValueError, match=r"must have shape \(2, 3\)"):
        envs.make("hopper", "host", num_envs=2).step(np.zeros((1, 3)))
