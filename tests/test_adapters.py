"""Tasks that are not of this project: any task of a suite by name, and anybody's own."""

import collections
import shutil
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import State
from dm_control import suite

from tests.helpers import assert_resumes_exactly, check_log, command
from vecpsmbpo import config, envs, jsonl
from vecpsmbpo.envs import termination
from vecpsmbpo.envs.mjx.adapter import Adapter
from vecpsmbpo.settings import SettingError

EXAMPLES = Path(__file__).parents[1] / "docs" / "examples"
HOSTED = [
    ("gymnasium", {"id": "Swimmer-v5"}),
    ("gymnasium", {"id": "Pendulum-v1"}),  # no MuJoCo: its state is on the Python object
    ("gymnasium", {"id": "Pusher-v5"}),
    ("dm_control", {"domain": "finger", "task": "turn_easy"}),  # moves its target by changing the model
    ("dm_control", {"domain": "reacher", "task": "hard"}),
    ("dm_control", {"domain": "manipulator", "task": "bring_ball"}),  # props and targets in the model, too
    ("metaworld", {"task": "door-open-v3"}),
]


@pytest.mark.parametrize(("name", "options"), HOSTED, ids=lambda value: str(value))
def test_any_hosted_task_resumes_exactly(name, options):
    env, other = (envs.make(name, "host", num_envs=2, seed=seed, **options) for seed in (3, 99))
    assert_resumes_exactly(env, other, 30)


def test_a_gymnasium_task_is_the_suite_s_own():
    env = envs.make("gymnasium", id="Swimmer-v5", seed=7)
    own = gymnasium.make("Swimmer-v5")
    np.testing.assert_array_equal(env.reset()[0], own.reset(seed=7)[0].astype(np.float32))
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 2)):
        step, (obs, reward, *_) = env.step(action[None]), own.step(action.astype(np.float32))
        np.testing.assert_array_equal(step.next_obs[0], obs.astype(np.float32))
        assert step.reward[0] == np.float32(reward)
    assert (env.spec.obs_size, env.spec.action_size, env.spec.episode_length) == (8, 2, 1000)
    assert envs.make("gymnasium", id="Reacher-v5").spec.episode_length == 50


def test_a_dm_control_task_is_the_suite_s_own():
    env = envs.make("dm_control", domain="finger", task="spin", seed=7)
    own = suite.load("finger", "spin", task_kwargs={"random": 7})
    flat = lambda timestep: np.concatenate([np.ravel(x) for x in timestep.observation.values()])  # noqa: E731
    np.testing.assert_array_equal(env.reset()[0], flat(own.reset()).astype(np.float32))
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 2)):
        step, theirs = env.step(action[None]), own.step(action)
        np.testing.assert_array_equal(step.next_obs[0], flat(theirs).astype(np.float32))
        assert step.reward[0] == np.float32(theirs.reward)
    assert env.spec.episode_length == own._step_limit == 1000


@pytest.mark.parametrize(
    "env_id", [f"{name}-v5" for name, rule in termination.OF_GYMNASIUM.items() if rule is not termination.never]
)
def test_known_termination_rules_are_gymnasium_s(env_id):
    env = envs.make("gymnasium", id=env_id)
    random, ends = np.random.default_rng(0), 0
    obs = env.reset()
    for _ in range(400):
        action = random.uniform(-1, 1, (1, env.spec.action_size))
        step = env.step(action)
        ours = env.spec.terminated(jnp.asarray(obs), jnp.asarray(action), jnp.asarray(step.next_obs))
        assert bool(ours[0]) == bool(step.terminated[0])
        ends += int(step.terminated[0])
        obs = step.obs
    assert ends > 0


def test_a_task_without_its_version_is_the_newest():
    spec = envs.make("gymnasium", id="Hopper").spec
    assert (spec.name, spec.terminated) == ("Hopper-v5", termination.hopper_falls)


def test_of_other_tasks_termination_is_learned():
    assert envs.make("gymnasium", id="Pendulum-v1").spec.terminated is None
    assert envs.make("gymnasium", id="Swimmer-v5").spec.terminated is termination.never


@pytest.mark.parametrize(
    ("name", "options", "complaint"),
    [
        ("gymnasium", {"id": "CartPole-v1"}, "its actions are Discrete"),
        ("gymnasium", {"id": "FrozenLake-v1"}, "its observations are Discrete"),
        ("gymnasium", {"id": "Hoper-v5"}, "env.id=Hoper-v5: "),
        ("gymnasium", {"id": "Ant-v3"}, "env.id=Ant-v3: "),  # of a package that is not installed
        ("dm_control", {"domain": "fingr", "task": "spin"}, "env.domain=fingr: must be one of acrobot"),
        ("dm_control", {"domain": "finger", "task": "spn"}, "env.task=spn: must be one of spin"),
        ("dm_control", {"domain": "lqr", "task": "lqr_2_1"}, "its actions are not bounded"),
        ("metaworld", {"task": "door"}, "env.task=door: must be one of"),
        ("brax", {"id": "reachr"}, "env.id=reachr: must be one of"),
        ("custom", {"make": "nowhere"}, "must be package.module:attribute"),
        ("custom", {"make": "no_such_module:Task"}, "No module named"),
        ("custom", {"make": "os:getcwd"}, "gives str, not a brax.envs.base.Env"),
    ],
)
def test_what_cannot_be_learned_is_refused(name, options, complaint):
    with pytest.raises(SettingError, match=complaint):
        envs.make(name, **options)


class Pictures(gymnasium.Env):
    """Observations that are images, and parts of observations by name."""

    observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (1,))


class Parts(Pictures):
    observation_space = gymnasium.spaces.Dict({"a": gymnasium.spaces.Box(-1, 1, (2,))})


@pytest.mark.parametrize("kind", ["Pictures", "Parts"])
def test_images_and_dictionaries_are_refused(kind):
    with pytest.raises(SettingError, match=r"only vectors \(Box of one dimension\)"):
        envs.make("custom", "host", make=f"{__name__}:{kind}")


class Walk(gymnasium.Env):
    """One step to the right each time, on a floor of JAX arrays, dictionaries and a history; it ends beyond 5, and is
    cut short at 3 where the history is longer than 4."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def termination_rule(obs, action, next_obs):
        return next_obs[..., 0] > 5

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = jnp.zeros(1)
        self.memory = {"steps": 0, "seen": (0.0, [1.0])}
        self.history = collections.deque(maxlen=8)
        return np.asarray(self.place), {}

    def step(self, action):
        self.place = self.place + 1 + 0 * action[0]
        self.memory["steps"] += 1
        self.history.append(float(self.place[0]))
        cut = len(self.history) > 4 and self.place[0] == 3
        reward = float(self.memory["steps"] + sum(self.history))
        return np.asarray(self.place), reward, bool(self.place[0] > 5), bool(cut), {}


def limited_walk():
    return gymnasium.wrappers.TimeLimit(Walk(), 4)


def test_an_own_environment_has_its_own_rule_and_ends():
    env = envs.make("custom", "host", make=f"{__name__}:Walk")
    rule = env.spec.terminated
    np.testing.assert_array_equal(rule(None, None, jnp.array([[5.0], [6.0]])), [False, True])
    env.reset()
    steps = [env.step(np.zeros((1, 1))) for _ in range(6)]
    assert [bool(step.terminated[0]) for step in steps] == [False] * 5 + [True]
    assert env.spec.episode_length == 1000


def test_an_environment_that_cuts_its_episodes_short_is_heeded():
    env = envs.make("custom", "host", make=f"{__name__}:limited_walk")
    assert env.spec.episode_length == 4
    env.episode_length = 100  # as a setting may ask; the wrapper ends it all the same
    env.reset()
    steps = [env.step(np.zeros((1, 1))) for _ in range(5)]
    assert [bool(step.truncated[0]) for step in steps] == [False, False, False, True, False]
    assert not any(step.terminated[0] for step in steps)
    assert (steps[3].next_obs[0, 0], steps[3].obs[0, 0], steps[4].next_obs[0, 0]) == (4, 0, 1)


@pytest.mark.parametrize("make", ["Walk", "limited_walk"])
def test_what_an_environment_and_its_wrappers_remember_is_saved(make):
    env, other = (envs.make("custom", "host", num_envs=2, seed=seed, make=f"{__name__}:{make}") for seed in (3, 99))
    assert_resumes_exactly(env, other, 30)


def test_a_brax_task_steps_as_brax_does():
    _assert_steps_alike(envs.make("brax", id="reacher"))


def test_a_playground_task_steps_as_playground_does():
    pytest.importorskip("mujoco_playground")
    _assert_steps_alike(envs.make("playground", id="CartpoleBalance"))


def _assert_steps_alike(env):
    own = env.inner
    key, action = jax.random.key(0), jnp.linspace(0.3, -2.0, env.action_size)
    state, theirs = jax.jit(env.reset)(key), jax.jit(own.reset)(key)
    np.testing.assert_array_equal(state.obs, theirs.obs)
    state, theirs = jax.jit(env.step)(state, action), jax.jit(own.step)(theirs, action.clip(-1, 1))
    np.testing.assert_allclose(state.obs, theirs.obs, rtol=1e-5, atol=1e-6)
    assert float(state.reward) == pytest.approx(float(theirs.reward), rel=1e-5)


class Counter:
    """A JAX environment whose state counts steps and pays their number."""

    observation_size, action_size = 1, 1

    def reset(self, key):
        return State(None, jnp.zeros(1), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return state.replace(obs=state.obs + 1, reward=state.obs[0] + 1)


def test_actions_are_repeated_where_a_task_says_so():
    env = Adapter(Counter(), "", "counter", 12, None, action_repeat=3)
    state = env.step(env.reset(jax.random.key(0)), jnp.zeros(1))
    assert (float(state.obs[0]), float(state.reward)) == (3, 1 + 2 + 3)
    assert env.spec.episode_length == 4


@pytest.mark.slow
@pytest.mark.parametrize(
    "task",
    [
        ["env=gymnasium", "env.id=Reacher-v5"],
        ["env=gymnasium", "env.id=MountainCarContinuous-v0"],
        ["env=dm_control", "env.domain=pendulum", "env.task=swingup"],
        ["env=metaworld", "env.task=button-press-v3"],
        ["env=brax", "env.id=inverted_pendulum"],
        ["env=playground", "env.id=CartpoleBalance"],
    ],
    ids=" ".join,
)
def test_a_task_of_every_suite_trains_and_resumes(task, tmp_path):
    if "env=playground" in task:
        pytest.importorskip("mujoco_playground")
    for total in (80, 120):
        result = command("train", *task, "size=tiny", "run_dir=run", f"total_steps={total}", cwd=tmp_path)
        assert result.returncode == 0, result.stderr
    assert "resuming at step 80" in result.stdout
    check_log(tmp_path / "run", config.load(tmp_path / "run"))


@pytest.mark.parametrize(
    ("example", "options"),
    [
        ("pendulum_mjx:Pendulum", []),
        ("pendulum_mujoco:Pendulum", ["backend=host"]),
        ("point_mass_gymnasium:PointMass", ["backend=host"]),
    ],
)
def test_the_examples_train_from_outside_of_the_package(example, options, tmp_path):
    shutil.copytree(EXAMPLES, tmp_path / "mine")
    result = command(
        "train", "env=custom", f"env.make={example}", "size=tiny", *options, "run_dir=run", cwd=tmp_path / "mine"
    )
    assert result.returncode == 0, result.stderr
    settings = config.load(tmp_path / "mine" / "run")
    assert dict(settings.env_options) == {"make": example}
    assert len(jsonl.read(tmp_path / "mine" / "run" / "metrics.jsonl")) == 3
    again = command("train", "run_dir=run", "total_steps=160", cwd=tmp_path / "mine")
    assert again.returncode == 0, again.stderr
    assert "resuming at step 120" in again.stdout
