"""An environment whose value function is known in closed form, for both drivers.

obs alternates 0, 1, 0, 1, …; at obs 1 the reward is 1 - a². With discount γ and the best action 0,

    V(1) = 1 + γ V(0),  V(0) = γ V(1)   where episodes are only truncated: V(1) = 1 / (1 - γ²)
    V(1) = 1,           V(0) = γ        where the step from obs 1 terminates.

Taking a truncation for a termination, or the observation after a reset for the successor, changes the values.
"""

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State

from vecpsmbpo.envs.host.batched import HostEnv, Simulator
from vecpsmbpo.types import EnvSpec

EPISODE_LENGTH = 3


def spec(terminates: bool) -> EnvSpec:
    def terminated(obs, action, next_obs):
        return (obs[..., 0] > 0.5) & terminates

    return EnvSpec("probe", obs_size=1, action_size=1, episode_length=EPISODE_LENGTH, terminated=terminated)


class Probe(Env):
    """In JAX, for the scan driver."""

    def __init__(self, terminates: bool):
        self.spec = spec(terminates)

    def reset(self, rng: jax.Array) -> State:
        return State(None, jnp.zeros(1), reward=jnp.zeros(()), done=jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        reward = state.obs[0] * (1 - action[0] ** 2)
        done = self.spec.terminated(state.obs, action, state.obs).astype(jnp.float32)
        return state.replace(obs=1 - state.obs, reward=reward, done=done)

    @property
    def observation_size(self) -> int:
        return 1

    @property
    def action_size(self) -> int:
        return 1

    @property
    def backend(self) -> str:
        return "none"


class ProbeSimulator(Simulator):
    """In numpy, for the host driver."""

    def __init__(self, terminates: bool):
        self._terminates = terminates
        self._obs = 0.0

    def reset(self) -> np.ndarray:
        self._obs = 0.0
        return np.array([0.0])

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        reward, terminated = self._obs * (1 - action[0] ** 2), self._obs > 0.5 and self._terminates
        self._obs = 1 - self._obs
        return np.array([self._obs]), reward, terminated, False

    def save(self) -> dict[str, Any]:
        return {"obs": self._obs}

    def load(self, saved: dict[str, Any]) -> None:
        self._obs = saved["obs"]


def host(terminates: bool, *, num_envs: int, seed: int) -> HostEnv:
    return HostEnv(spec(terminates), [ProbeSimulator(terminates) for _ in range(num_envs)])


# ── that diverge now and then, at a reset or at a step ──────────────────────────────────────────────────────────


class FailingProbe(Probe):
    """Of a JAX environment only its state is kept: an episode draws the step at which it fails, from 0 (its reset)."""

    def __init__(self):
        super().__init__(terminates=False)

    def reset(self, rng: jax.Array) -> State:
        fails_at = jax.random.randint(rng, (), 0, 3 * EPISODE_LENGTH)
        return super().reset(rng).replace(pipeline_state=fails_at, obs=jnp.where(fails_at == 0, jnp.nan, jnp.zeros(1)))

    def step(self, state: State, action: jax.Array) -> State:
        left = state.pipeline_state - 1
        after = super().step(state.replace(obs=jnp.nan_to_num(state.obs)), action)
        fails = left == 0
        diverges = jnp.where(action[0] > 0.5, 1e20, jnp.nan)  # on its way there, and there
        obs = jnp.where(fails & (action[0] > 0), diverges, after.obs)
        reward = jnp.where(fails & (action[0] <= 0), jnp.where(action[0] < -0.5, jnp.nan, jnp.inf), after.reward)
        return after.replace(pipeline_state=left, obs=obs, reward=reward)


class FailingGymnasium(gymnasium.Env):
    """Every seventh step and every twentieth reset fails; the seed says where it begins to count."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self):
        self.obs, self.steps, self.resets = 0.0, 0, 0

    @staticmethod
    def termination_rule(obs, action, next_obs):
        return spec(False).terminated(obs, action, next_obs)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = self.steps if seed is None else seed % 7
        self.obs, self.resets = 0.0, self.resets + 1
        return np.array([0.0 if self.resets % 20 else np.nan]), {}

    def step(self, action):
        reward = self.obs * (1 - float(action[0]) ** 2)
        self.obs, self.steps = 1 - self.obs, self.steps + 1
        fails = self.steps % 7 == 0
        # On its way to infinity, there in float32, and beyond.
        diverges = 1e20 if action[0] > 0.6 else 1e39 if action[0] > 0.3 else np.nan
        obs = np.array([diverges if fails and action[0] > 0 else self.obs])
        fault = np.nan if action[0] < -0.5 else -np.inf
        return obs, fault if fails and action[0] <= 0 else reward, False, False, {}


# ── that draws itself, and is no MuJoCo task ────────────────────────────────────────────────────────────────────


class Lamp(gymnasium.Env):
    """Lighter by the action's size at every step, until it is white."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = gymnasium.spaces.Box(0.0, 1.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, render_mode=None):
        self.render_mode, self.light = render_mode, 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.light = 0.0
        return np.array([self.light], np.float32), {}

    def step(self, action):
        self.light = min(self.light + abs(float(action[0])) / 10, 1.0)
        return np.array([self.light], np.float32), 1.0, False, False, {}

    def render(self):
        return np.full((60, 80, 3), round(255 * self.light), np.uint8)


class Blind(Lamp):
    """Takes no render mode."""

    def __init__(self):
        super().__init__()


def drawn_lamp() -> Lamp:
    return Lamp(render_mode="rgb_array")


gymnasium.register("Lamp-v0", entry_point="tests.probes:Lamp", max_episode_steps=30)
gymnasium.register("Blind-v0", entry_point="tests.probes:Blind")
