"""The tasks against their originals: Gymnasium and dm_control."""

import functools
import json
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dm_control import suite

from tests.helpers import assert_resumes_exactly
from tools import parity
from vecpsmbpo import envs
from vecpsmbpo.envs import registry, specs, speeds
from vecpsmbpo.settings import SettingError


@pytest.fixture(scope="module")
def ports():
    """An MJX port by name, with its functions compiled once."""
    return functools.cache(parity.Port)


@pytest.fixture(scope="module", params=registry.names("mjx"))
def port(request, ports):
    return ports(request.param)


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


@pytest.mark.parametrize("name", parity.THRESHOLDS)
def test_steps_near_termination_are_those_of_the_original(name, ports):
    port = ports(name)
    steps = parity.collect(name, parity.uniform(1, port.env.action_size), states=150, seed=4, near=True)
    found = parity.compare_steps(port, steps)
    assert 20 < found["terminations"] < 130
    assert found["terminated_agree"] == 1
    assert found["obs_p99"] < 1e-3


def test_sizes_are_those_of_the_registry(port):
    spec, task = port.env.spec, registry.TASKS[port.env.spec.name]
    host = envs.make(spec.name, "host")
    state = port.env.reset(jax.random.key(0))
    assert state.obs.shape == (task.sizes.obs_size,) == host.reset().shape[1:]
    assert port.env.action_size == task.sizes.action_size
    assert spec.episode_length == host.episode_length == task.sizes.episode_length


def test_resets_are_distributed_as_the_original_s(port):
    """3,000 resets: noise that is a third too wide would be found."""
    p_value, coordinate = parity.compare_resets(port, port.env.spec.name, 3000)
    assert p_value > 1e-3, coordinate


@pytest.mark.parametrize(("name", "still"), [("hopper", False), ("walker2d", True), ("ball_in_cup", True)])
def test_whole_episodes_are_as_long_and_earn_as_much_as_the_original_s(name, still, ports):
    """Of a random policy, and of a fixed one: no force at all."""
    port = ports(name)
    policy = (lambda obs, t, key: jnp.zeros((*obs.shape[:-1], port.env.action_size))) if still else None
    found = parity.compare_episodes(port, name, policy or parity.uniform(1, port.env.action_size), 60)
    assert found["return_p"] > 1e-3
    assert found["length_p"] > 1e-3


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
    ("name", "z", "angle", "ends"),
    [
        ("ant", 0.2, 0.0, False),  # both limits belong to the healthy range
        ("ant", 1.0, 0.0, False),
        ("ant", 0.199, 0.0, True),
        ("ant", 1.001, 0.0, True),
        ("ant", 0.5, np.nan, True),
        ("walker2d", 1.2, 0.0, False),
        ("walker2d", 0.8, 0.0, True),  # neither does
        ("walker2d", 2.0, 0.0, True),
        ("walker2d", 1.2, 1.0, True),
        ("walker2d", 1.2, -1.01, True),
        ("walker2d", 1.2, 0.99, False),
    ],
)
def test_ant_s_and_walker2d_s_termination_rules(name, z, angle, ends):
    spec = specs.get(name)
    obs = jnp.zeros(spec.obs_size).at[:2].set(jnp.array([z, angle]))
    assert bool(spec.terminated(obs, None, obs)) == ends


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


@pytest.mark.parametrize(
    ("name", "original"),
    [("ant", "Ant-v4"), ("halfcheetah", "HalfCheetah-v4"), ("hopper", "Hopper-v4"), ("walker2d", "Walker2d-v4")],
)
def test_gymnasium_s_tasks_step_bit_for_bit(name, original):
    """Over several episodes (or the beginning of one), against the suite used directly."""
    ours, own = envs.make(name, "host", seed=7), gymnasium.make(original, max_episode_steps=-1)
    obs = own.reset(seed=7)[0]
    np.testing.assert_array_equal(ours.reset()[0], obs.astype(np.float32))
    for action in np.random.default_rng(0).uniform(-1, 1, (150, ours.spec.action_size)):
        scaled = action * own.action_space.high  # symmetric in all of them
        step, (obs, reward, terminated, *_) = ours.step(action[None]), own.step(scaled.astype(np.float32))
        np.testing.assert_array_equal(step.next_obs[0], obs.astype(np.float32))
        assert (step.reward[0], step.terminated[0]) == (np.float32(reward), terminated)
        if terminated:
            np.testing.assert_array_equal(step.obs[0], own.reset()[0].astype(np.float32))


@pytest.mark.parametrize(
    ("name", "domain", "task"),
    [
        ("ball_in_cup", "ball_in_cup", "catch"),
        ("cartpole_swingup", "cartpole", "swingup"),
        ("cartpole_swingup_sparse", "cartpole", "swingup_sparse"),
    ],
)
def test_dm_control_s_tasks_step_bit_for_bit(name, domain, task):
    """Over two episodes, the suite's own time limit and reset between them."""
    ours = envs.make(name, "host", seed=7)
    own = suite.load(domain, task, task_kwargs={"random": 7})
    flat = lambda timestep: np.concatenate([np.ravel(x) for x in timestep.observation.values()])  # noqa: E731
    np.testing.assert_array_equal(ours.reset()[0], flat(own.reset()).astype(np.float32))
    for action in np.random.default_rng(0).uniform(-1, 1, (1100, ours.spec.action_size)):
        step, theirs = ours.step(action[None]), own.step(action)
        np.testing.assert_array_equal(step.next_obs[0], flat(theirs).astype(np.float32))
        assert step.reward[0] == np.float32(theirs.reward)
        assert step.truncated[0] == theirs.last()
        if theirs.last():
            np.testing.assert_array_equal(step.obs[0], flat(own.reset()).astype(np.float32))


@pytest.mark.parametrize("backend", ["mjx", "host"])
def test_warnings_leave_no_file_behind(backend, tmp_path, monkeypatch):
    """MuJoCo warns of an old attribute in HalfCheetah's model, by default into the working directory."""
    monkeypatch.chdir(tmp_path)
    envs.make("halfcheetah", backend)
    assert not list(tmp_path.iterdir())


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


def test_a_faster_backend_is_named_where_it_was_measured():
    """By results/gpu/bench_envs.jsonl 3,426 steps per second against 97, 35 times as many, and 14,355 against 2,108."""
    assert "C MuJoCo stepped 1 of hopper 35 times as fast as MJX" in speeds.hint("hopper", "mjx", "gpu", 2)
    assert "stepped 10 of halfcheetah 7 times" in speeds.hint("halfcheetah", "mjx", "gpu", 12)
    for name, backend, platform, lanes in (
        ("hopper", "mjx", "gpu", 100),
        ("hopper", "host", "gpu", 1),
        ("hopper", "mjx", "cpu", 1),
        ("cartpole_swingup", "mjx", "gpu", 1),
    ):
        assert speeds.hint(name, backend, platform, lanes) == ""


def test_speeds_are_those_that_were_measured():
    rows = [
        json.loads(line)
        for line in (Path(__file__).parents[1] / "results/gpu/bench_envs.jsonl").read_text().splitlines()
    ]
    measured = {(row["env"], row["backend"], row["batch"]): row["steps_per_s"] for row in rows}
    for name, by_lanes in speeds.ON_GPU.items():
        for lanes, (mjx, original) in by_lanes.items():
            assert mjx == pytest.approx(measured[name, "mjx", lanes], rel=0.01)
            assert original == pytest.approx(measured[name, "host", lanes], rel=0.01)


def test_mistakes_are_named():
    with pytest.raises(SettingError, match="must be one of ant"):
        envs.make("hoper")
    with pytest.raises(SettingError, match="backend=gpu: must be auto or mjx or host"):
        envs.make("hopper", "gpu")
    with pytest.raises(ValueError, match=r"must have shape \(2, 3\)"):
        envs.make("hopper", "host", num_envs=2).step(np.zeros((1, 3)))


def test_a_task_s_original_is_no_option_of_it():
    with pytest.raises(SettingError, match=r"env=hopper env.id=Ant-v4: cannot be made \(TypeError"):
        envs.make("hopper", "host", id="Ant-v4")
