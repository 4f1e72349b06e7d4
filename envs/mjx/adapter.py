"""Other libraries' JAX environments behind the interface of this one."""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State

from vecpsmbpo.envs.mjx.base import SpecEnv
from vecpsmbpo.settings import SettingError
from vecpsmbpo.types import EnvSpec, TerminationRule


class Adapter(SpecEnv):
    """An environment of Brax's or Playground's shape, without wrappers: no time limit and no reset of its own.

    Its whole state travels as `pipeline_state`; `done` is taken for termination.

    Attributes:
        inner: the environment; `reset(key)` and `step(state, action)` give states with `obs`, `reward`, `done`.
    """

    def __init__(
        self,
        inner: Any,
        label: str,
        name: str,
        episode_length: int,
        terminated: TerminationRule | None,
        action_repeat: int = 1,
    ):
        """
        Args:
            label: for errors, such as `env.id=reacher`.
            episode_length: steps of `inner`.
            action_repeat: steps of `inner` that one action is held for; their rewards are added.

        Raises:
            SettingError: its observations are not one vector.
        """
        size = inner.observation_size
        if not isinstance(size, int):
            raise SettingError(f"{label}: its observations are {size}; only one vector can be learned")
        self.inner = inner
        self._action_repeat = action_repeat
        self.spec = EnvSpec(name, size, inner.action_size, episode_length // action_repeat, terminated)

    def reset(self, rng: jax.Array) -> State:
        return self._shown(self.inner.reset(rng))

    def step(self, state: State, action: jax.Array) -> State:
        action = jnp.clip(action, -1.0, 1.0)

        def once(inner: Any, _: None) -> tuple[Any, jax.Array]:
            with jax.default_matmul_precision("highest"):  # as for the ports: TF32 hurts physics
                after = self.inner.step(inner, action)
            # Scans and checkpoints need every leaf to keep its type.
            after = jax.tree.map(lambda new, old: jnp.asarray(new, jnp.asarray(old).dtype), after, inner)
            return after, after.reward

        inner, rewards = jax.lax.scan(once, state.pipeline_state, length=self._action_repeat)
        return self._shown(inner).replace(reward=jnp.sum(rewards).astype(jnp.float32))

    def _shown(self, inner: Any) -> State:
        obs, reward, done = (jnp.asarray(x, jnp.float32) for x in (inner.obs, inner.reward, inner.done))
        return State(inner, obs, reward, done)
