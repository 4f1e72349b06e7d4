"""A MuJoCo task on MJX as a Brax environment."""

import abc
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import Env, State

from vecpsmbpo.envs.mjx.simulator import Physics, Simulator
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec


class SpecEnv(Env):
    """A Brax environment that has an `EnvSpec`."""

    spec: EnvSpec

    @property
    def observation_size(self) -> int:
        return self.spec.obs_size

    @property
    def action_size(self) -> int:
        return self.spec.action_size

    @property
    def backend(self) -> str:
        return "mjx"


class MjxEnv(SpecEnv):
    """Base of the MJX ports: a subclass gives the model, the reset distribution, observation, reward and spec.

    There is no auto-reset and no time limit inside: `step` returns the true successor, `State.done` is termination
    only.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, *, line_search_iterations: int | None = None):
        """
        Args:
            model: of the original task, unchanged.
            substeps: simulator steps per control step.
            line_search_iterations: most of them, see `simulator.LINE_SEARCH_ITERATIONS`; None: as the model says.

        Raises:
            SettingError: an actuator has no control range, to which actions are scaled.
        """
        for index, (low, high) in enumerate(model.actuator_ctrlrange):
            if low >= high:
                raise SettingError(f"actuator {model.actuator(index).name or index}: its model gives it no ctrlrange")
        self.model = model
        self.substeps = substeps
        self._simulator = Simulator(model, line_search_iterations)

    # what a task defines

    @abc.abstractmethod
    def initial_state(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """A draw from ρ(s): qpos [nq], qvel [nv]."""

    @abc.abstractmethod
    def observe(self, physics: Physics) -> jax.Array:
        """[O]."""

    @abc.abstractmethod
    def reward(self, before: Physics, action: jax.Array, after: Physics) -> jax.Array:
        """[], for the control step that led from `before` to `after`."""

    def terminated(self, obs: jax.Array, action: jax.Array, after: Physics) -> jax.Array:
        """[] bool, for the control step from `obs` to `after`: by the spec's rule on observations.

        A task whose spec has no rule, or that knows better than observations tell, overrides this.
        """
        rule = self.spec.terminated
        return rule(obs, action, self.observe(after)) if rule else jnp.bool_(False)

    # the environment

    def reset(self, rng: jax.Array) -> State:
        return self.state_at(*self.initial_state(rng))

    def state_at(self, qpos: jax.Array, qvel: jax.Array) -> State:
        """The state at a simulator state: qpos [nq], qvel [nv], with a cold solver."""
        qpos, qvel = jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)
        physics = self._simulator.at_rest(qpos, qvel)
        return State(physics, self.observe(physics), reward=jnp.zeros(()), done=jnp.zeros(()))

    def step(self, state: State, action: jax.Array) -> State:
        before: Any = state.pipeline_state
        action = jnp.clip(action, -1.0, 1.0)
        # TF32 matrix products hurt physics on GPUs.
        with jax.default_matmul_precision("highest"):
            after = self._advance(before, self.control(action))
            return state.replace(
                pipeline_state=after,
                obs=self.observe(after),
                reward=self.reward(before, action, after),
                done=self.terminated(state.obs, action, after).astype(jnp.float32),
            )

    def control(self, action: jax.Array) -> jax.Array:
        """Actions in [-1, 1] -> the actuators' control range, [A] each."""
        low, high = jnp.asarray(self.model.actuator_ctrlrange, jnp.float32).T
        return low + (action + 1) * (high - low) / 2

    def _advance(self, physics: Physics, control: jax.Array) -> Physics:
        def substep(_, physics: Physics) -> Physics:
            return self._simulator.step(physics, control)

        if self.substeps == 1:
            return substep(0, physics)
        return jax.lax.fori_loop(0, self.substeps, substep, physics)
