"""What tasks and simulators that are written carelessly do: one line each."""

import os

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Env, State

from vecpsmbpo import envs
from vecpsmbpo.envs.host.batched import HostEnv, SimulatorError
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec

TASKS = {
    "number = 5": ":number",
    "class Wants:\n    def __init__(self, x): pass": ":Wants",
    "def fails(): raise KeyError('no')": ":fails",
    "def leaves(): raise SystemExit(0)": ":leaves",
    "class Odd(BaseException): pass\ndef raises(): raise Odd('no')": ":raises",
    "import nowhere_at_all": ":X",
    "raise RuntimeError('at import')": ":X",
    "def (": ":X",
    "raise SystemExit(0)": ":X",
    "import os": ":os",
    "X = None": "",
    "Y = None": ":X",
    "from gymnasium import Env as X": ":X",
}


@pytest.mark.parametrize("backend", ["host", "mjx"])
def test_a_task_that_cannot_be_made_is_one_line(backend, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for index, (code, attribute) in enumerate(TASKS.items()):
        make = f"careless_{backend}_{index}{attribute}"
        (tmp_path / f"careless_{backend}_{index}.py").write_text(code)
        with pytest.raises(SettingError, match=r"env\.make=careless") as error:
            envs.make("custom", backend, make=make)
        assert "\n" not in str(error.value)


class Nothing(gymnasium.Env):
    """A task in which there is nothing to see, or with `Idle` nothing to do."""

    observation_space = gymnasium.spaces.Box(-1, 1, (0,))
    action_space = gymnasium.spaces.Box(-1, 1, (2,))


class Idle(Nothing):
    observation_space, action_space = Nothing.action_space, Nothing.observation_space


@pytest.mark.parametrize(("kind", "sizes"), [("Nothing", r"0 obs.* and 2 act"), ("Idle", r"2 obs.* and 0 act")])
def test_a_task_has_something_to_see_and_to_do(kind, sizes):
    with pytest.raises(SettingError, match=rf"env\.make=\S+: has {sizes}.*at least one of each"):
        envs.make("custom", "host", make=f"{__name__}:{kind}")


class Elsewhere(Nothing):
    observation_space = Nothing.action_space

    def __init__(self):
        os.chdir("/")


def test_a_task_that_leaves_the_working_directory_does_not_take_the_run_along(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    envs.make("custom", "host", make=f"{__name__}:Elsewhere")
    assert os.getcwd() == str(tmp_path)


RULES = {
    "one answer for all": (lambda obs, action, next_obs: jnp.all(next_obs > 5), r"gives bool\[\] for 7 transitions"),
    "the first transition": (lambda obs, action, next_obs: next_obs[0] > 5, r"gives bool\[2\] for 7 transitions"),
    "a number": (lambda obs, action, next_obs: next_obs[:, 0], r"gives float32\[7\] for 7 transitions, not bool\[7\]"),
    "nothing": (lambda obs, action, next_obs: None, "gives nothing for 7 transitions"),
    "of the object": (lambda self, obs, action, next_obs: obs[..., 0] > 0, "missing 1 required positional argument"),
}


@pytest.mark.parametrize(("rule", "line"), RULES.values(), ids=RULES)
def test_a_termination_rule_answers_for_each_of_a_batch(rule, line, monkeypatch):
    monkeypatch.setattr(Idle, "action_space", Idle.observation_space)
    monkeypatch.setattr(Idle, "termination_rule", rule, raising=False)
    with pytest.raises(SettingError, match=line):
        envs.make("custom", "host", make=f"{__name__}:Idle")
    monkeypatch.setattr(Idle, "termination_rule", lambda obs, action, next_obs: next_obs[..., 0] > 5)
    assert envs.make("custom", "host", make=f"{__name__}:Idle").spec.obs_size == 2


class Stays(Env):
    """An environment of two numbers in which nothing happens."""

    spec = EnvSpec("stays", 2, 1, 10, None)
    observation_size, action_size, backend = 2, 1, "none"

    def reset(self, rng):
        return State(None, jnp.zeros(2), jnp.zeros(()), jnp.zeros(()))

    def step(self, state, action):
        return self.change(state)


WRONG_STATES = {
    "another observation": (lambda state: state.replace(obs=jnp.zeros(3)), r"its step gives obs of shape \(3,\), not"),
    "a vector of rewards": (lambda state: state.replace(reward=jnp.zeros(1)), r"reward of shape \(1,\), not \(\)"),
    "a number": (lambda state: 5, "its step gives an array, not a brax.envs.base.State"),
    "other parts": (lambda state: state.replace(info={"x": 1}), "its step gives a State of other parts"),
    "another type": (
        lambda state: state.replace(done=state.done > 0),
        "gives State.done as bool.*its reset as float32",
    ),
}


@pytest.mark.parametrize(("change", "line"), WRONG_STATES.values(), ids=WRONG_STATES)
def test_a_state_that_a_task_cannot_give_is_one_line(change, line, monkeypatch):
    monkeypatch.setattr(Stays, "change", lambda self, state: change(state), raising=False)
    with pytest.raises(SettingError, match=rf"^env\.make=\S+: .*{line}"):
        envs.make("custom", "mjx", make=f"{__name__}:Stays")
    monkeypatch.setattr(Stays, "change", lambda self, state: state)
    assert envs.make("custom", "mjx", make=f"{__name__}:Stays").spec.obs_size == 2


class Simulator:
    """Gives what it was made with."""

    def __init__(self, *results):
        self._results = iter(results)

    def reset(self):
        return np.zeros(2)

    def step(self, action):
        result = next(self._results)
        if isinstance(result, BaseException):
            raise result
        return result


@pytest.mark.parametrize(
    ("result", "line"),
    [
        (ValueError("the motor is hot"), "ValueError: the motor is hot at "),
        (SystemExit(0), "SystemExit: 0 at "),
        ((np.zeros(3), 0.0, False, False), r"an observation has shape \(3,\), not \(2,\)"),
        ((np.zeros((1, 2)), 0.0, False, False), r"an observation has shape \(1, 2\), not"),
        ((None, 0.0, False, False), "an observation has shape|TypeError"),
        ((np.zeros(2), [1.0, 2.0], False, False), "ValueError|TypeError"),
        ((np.zeros(2), 0.0, False), "ValueError"),
    ],
)
def test_what_a_simulator_cannot_give_is_one_line(result, line):
    fine = (np.zeros(2), 0.0, False, False)
    env = HostEnv(EnvSpec("mine", 2, 1, 10, None), [Simulator(fine, fine), Simulator(fine, result)])
    env.reset()
    env.step(np.zeros((2, 1)))
    with pytest.raises(SimulatorError, match=line) as error:
        env.step(np.zeros((2, 1)))
    assert "\n" not in str(error.value)
