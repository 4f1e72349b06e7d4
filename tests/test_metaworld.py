"""Metaworld's tasks against Metaworld itself."""

import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
from metaworld.env_dict import ALL_V3_ENVIRONMENTS, ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE
from metaworld.policies import SawyerWindowOpenV3Policy
from metaworld.types import Task

from vecpsmbpo.envs.host.metaworld import MetaworldSimulator, WindowOpenSimulator, window_open
from vecpsmbpo.settings import SettingError

HAND, HANDLE, GOAL = slice(0, 3), slice(4, 7), slice(36, 39)
FRAME, FORMER_FRAME = slice(0, 18), slice(18, 36)
TRAVEL = 0.2  # m, of the joint window_slide in Metaworld's window_horiz.xml


@pytest.mark.parametrize("task", ["window-open-v3", "door-open-v3", "pick-place-v3"])
def test_steps_are_those_of_the_suite(task):
    suite = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-goal-observable"](seed=5)
    ours = MetaworldSimulator(task, 5)
    random = np.random.default_rng(0)
    for _ in range(2):
        np.testing.assert_array_equal(ours.reset(), suite.reset()[0])
        for _ in range(80):
            action = random.uniform(-1, 1, 4)
            obs, *rest, _ = suite.step(action)
            our_obs, *our_rest = ours.step(action)
            np.testing.assert_array_equal(our_obs, obs)
            assert our_rest == rest  # reward, terminated, truncated


def test_a_layout_is_one_task_of_metaworld_s_benchmarks():
    """MT1 hands out the random vector in a `Task` and shows the goal."""
    ours = MetaworldSimulator("door-open-v3", 1)
    suite = ALL_V3_ENVIRONMENTS["door-open-v3"]()
    layout = {"rand_vec": ours.env._last_rand_vec, "partially_observable": False, "env_cls": type(suite)}
    suite.set_task(Task("door-open-v3", pickle.dumps(layout)))
    np.testing.assert_array_equal(ours.reset(), suite.reset()[0])
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 4)):
        np.testing.assert_array_equal(ours.step(action)[0], suite.step(action)[0])


def test_the_first_observation_shows_the_window_where_it_is():
    """Unlike Metaworld's own with a new layout at each reset, which shows it where it is not."""
    suite = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE["window-open-v3-goal-observable"](seed=0)
    suite._freeze_rand_vec, suite.seeded_rand_vec = False, True
    first, still = suite.reset()[0], np.zeros(4)
    assert np.linalg.norm(suite.step(still)[0][HANDLE] - first[HANDLE]) > 0.01

    ours = WindowOpenSimulator(0, threshold=0.03)
    first = ours.reset()
    second = ours.step(still)[0]
    np.testing.assert_array_equal(second[HANDLE], first[HANDLE])
    np.testing.assert_array_equal(second[FORMER_FRAME], first[FRAME])


def test_every_episode_of_every_seed_is_on_the_same_task():
    one, other = window_open(num_envs=2, seed=0), window_open(num_envs=1, seed=123)
    one.episode_length = 30
    first = one.reset()
    np.testing.assert_array_equal(first[0], first[1])
    np.testing.assert_array_equal(first[:1], other.reset())
    for actions in np.random.default_rng(0).uniform(-1, 1, (30, 2, 4)):
        step = one.step(actions)
    assert step.truncated.all()
    assert (step.next_obs[:, HAND] != first[:, HAND]).any()
    np.testing.assert_array_equal(step.obs, first)
    np.testing.assert_array_equal(step.next_obs[:, GOAL], first[:, GOAL])


@pytest.mark.filterwarnings("ignore:Constant")  # of the scripted policy, which asks for more than an action can be
@pytest.mark.parametrize("threshold", [0.03, 0.1])
def test_opening_the_window_is_rewarded_from_the_threshold_on(threshold):
    """Metaworld's scripted policy opens it; how far it is open is read from the handle in the observation."""
    env, policy = window_open(num_envs=1, seed=0, threshold=threshold), SawyerWindowOpenV3Policy()
    obs = env.reset()
    closed, rewards, travels, from_goal = obs[0, HANDLE][0], [], [], []
    for _ in range(130):
        step = env.step(policy.get_action(obs[0])[None])
        obs = step.obs
        rewards.append(float(step.reward[0]))
        travels.append(step.next_obs[0, HANDLE][0] - closed)
        from_goal.append(abs(step.next_obs[0, HANDLE][0] - step.next_obs[0, GOAL][0]))
        assert not step.terminated.any()
    assert rewards == [0.0 if travel >= TRAVEL - threshold else -10.0 for travel in travels]
    assert rewards[0] == -10.0
    assert rewards[-1] == 0.0
    assert min(from_goal) > 0.03  # why the threshold is not applied to the distance from Metaworld's goal


@pytest.mark.parametrize(
    ("travel", "reward"), [(0.0, -10.0), (0.1, -10.0), (0.169, -10.0), (0.171, 0.0), (0.2, 0.0), (0.201, 0.0)]
)
def test_the_reward_at_a_window_placed_by_hand(travel, reward):
    simulator = WindowOpenSimulator(0, threshold=0.03)
    closed = simulator.reset()[HANDLE][0]
    simulator.env.data.joint("window_slide").qpos[0] = travel
    obs, ours, terminated, _ = simulator.step(np.zeros(4))
    assert obs[HANDLE][0] - closed == pytest.approx(travel, abs=2e-4)  # it stayed there
    assert (ours, terminated) == (reward, False)


def test_window_open_resumes_exactly():
    env, other = (window_open(num_envs=2, seed=seed) for seed in (3, 99))
    env.episode_length = other.episode_length = 40
    random = np.random.default_rng(0)
    np.testing.assert_array_equal(env.reset(), other.reset())
    for moment in (0, 1, 30, 39, 40, 7):  # at the start, mid-episode, the step before and the very moment of a reset
        for _ in range(moment):
            env.step(random.uniform(-1, 1, (2, 4)))
        np.testing.assert_array_equal(other.load(json.loads(json.dumps(env.save()))), env._obs)
        for _ in range(50):
            actions = random.uniform(-1, 1, (2, 4))
            for ours, theirs in zip(env.step(actions), other.step(actions), strict=True):
                np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("task", ALL_V3_ENVIRONMENTS)
def test_every_task_resumes_exactly(task):
    """Into a simulator of another layout, in another place of another episode; then on over a reset."""
    one, other = MetaworldSimulator(task, 3), MetaworldSimulator(task, 99)
    random = np.random.default_rng(0)
    one.reset()
    other.reset()
    for steps in (0, 35):
        for _ in range(steps):
            one.step(random.uniform(-1, 1, 4))
        for _ in range(5):
            other.step(random.uniform(-1, 1, 4))
        other.load(json.loads(json.dumps(one.save(), allow_nan=False)))
        for _ in range(2):
            for action in random.uniform(-1, 1, (25, 4)):
                (obs, reward, *_), (other_obs, other_reward, *_) = one.step(action), other.step(action)
                np.testing.assert_array_equal(obs, other_obs)
                assert reward == other_reward
            np.testing.assert_array_equal(one.reset(), other.reset())


def test_episodes_end_at_250_steps_as_truncated():
    env = window_open(num_envs=2, seed=0)
    env.reset()
    for count in range(1, 251):
        step = env.step(np.zeros((2, 4)))
        assert not step.terminated.any()
        assert step.truncated.tolist() == [count == 250] * 2


def test_there_is_no_other_time_limit():
    env = window_open(num_envs=1, seed=0)
    env.episode_length = 1000
    env.reset()
    for _ in range(520):
        step = env.step(np.zeros((1, 4)))
    assert not step.truncated.any()

    suite = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE["window-open-v3-goal-observable"](seed=0)
    suite.reset()
    for _ in range(500):
        suite.step(np.zeros(4))
    with pytest.raises(ValueError, match="must reset"):
        suite.step(np.zeros(4))


def test_neither_a_display_nor_another_suite_is_needed():
    program = (
        "import sys; from vecpsmbpo.envs.host.metaworld import window_open;"
        "env = window_open(num_envs=1, seed=0); env.reset(); env.step([[0, 0, 0, 0]]);"
        "assert 'dm_control' not in sys.modules"
    )
    without_display = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    subprocess.run([sys.executable, "-c", program], check=True, env=without_display | {"MUJOCO_GL": "disabled"})


def test_an_unknown_task_is_named():
    with pytest.raises(SettingError, match=r"env.task=window-ajar-v3: must be one of .*window-open-v3"):
        MetaworldSimulator("window-ajar-v3", 0)
