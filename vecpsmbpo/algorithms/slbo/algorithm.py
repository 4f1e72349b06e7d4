"""SLBO for one seed: model and policy learn in turns at every refresh."""

from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from vecpsmbpo import dynamics, feedforward, imagination
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.algorithms.slbo import multistep, trpo
from vecpsmbpo.algorithms.slbo.settings import SlboSettings
from vecpsmbpo.feedforward import Feedforward
from vecpsmbpo.types import Counters, Model, Params, Scaling, SeedState


class Slbo(Algorithm):
    """The policy learns by TRPO from rollouts in the model, which goes on learning meanwhile."""

    settings: SlboSettings

    @cached_property
    def nets(self) -> trpo.Networks:
        return trpo.make_networks(self.settings, self.spec)

    def init_agent(self, key: PRNGKeyArray) -> trpo.TrpoAgent:
        return trpo.init(key, self.nets, self.spec)

    def choose(
        self, counters: Counters, state: SeedState, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """A sample of the policy, clipped."""
        obs = _whitened(self._scaling(state), obs)
        sample = lambda params: self.nets.policy.distribution(params, obs).sample(key)  # noqa: E731
        return jnp.clip(self.layout.select_member(state.episode.member, state.agents.policy, sample), -1.0, 1.0), ()

    def evaluation_policy(self, state: SeedState, key: PRNGKeyArray) -> tuple[Params, Scaling]:
        return self.layout.select_member(jnp.int32(0), state.agents.policy), self._scaling(state)

    def evaluation_action(
        self,
        policy: tuple[Params, Scaling],
        step: Int[Array, ""],
        memory: Any,
        obs: Float[Array, "*batch O"],
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "*batch A"], Any]:
        params, scaling = policy
        distribution = self.nets.policy.distribution(params, _whitened(scaling, obs))
        action = distribution.loc if self.settings.eval_actions == "mean" else distribution.sample(key)
        return jnp.clip(action, -1.0, 1.0), ()

    def feedforward(self, policy: tuple[Params, Scaling]) -> Feedforward:
        params, scaling = policy
        layers = feedforward.dense_layers(params["params"]["TanhMLP_0"])
        size = self.spec.obs_size
        raw = feedforward.on_raw(layers, scaling.input_mean[:size], scaling.input_std[:size])
        return Feedforward(raw, hidden="tanh", end="clip")

    def _scaling(self, state: SeedState) -> Scaling:
        """That the policy was trained with: of its model, at the last refresh."""
        return jax.tree.map(lambda x: x[0], self.layout.all_models(state.models.scaling))

    def refresh(
        self, counters: Counters, state: SeedState, enabled: Bool[Array, ""], key: PRNGKeyArray
    ) -> tuple[Counters, SeedState]:
        """Alternates between fits of the model and steps of the policy (Algorithm 2, lines 5 to 9)."""
        layout = self.layout
        scaling = dynamics.scaling(state.moments, counters.env_steps, self.settings)
        fit = partial(multistep.fit, net=self.model_net, settings=self.settings, spec=self.spec)

        def learn(model, agent, key, counters, real, scaling, hyper):
            added = counters.env_steps

            def round_(learned, key):
                model, agent = learned
                model_key, policy_key = jax.random.split(key)
                model = fit(model, real, added, hyper, model_key)

                def policy_step(agent, key):
                    rollout_key, update_key = jax.random.split(key)
                    rollouts = self.rollouts(counters, real, model, agent.policy, rollout_key)
                    step = partial(trpo.update, settings=self.settings, nets=self.nets)
                    return step(agent, rollouts, hyper.discount, update_key), None

                agent, _ = jax.lax.scan(policy_step, agent, jax.random.split(policy_key, self.settings.policy_steps))
                return (model, agent), None

            model = model.replace(scaling=scaling)
            return jax.lax.scan(round_, (model, agent), jax.random.split(key, self.settings.rounds))[0]

        def learned(models, agents):
            keys = layout.keys(key, layout.member_ids())
            shared = counters, state.real, scaling, state.hyper
            return layout.map_local(learn, models, agents, keys, shared=shared)

        models, agents = jax.lax.cond(enabled, learned, lambda *same: same, state.models, state.agents)
        return counters, state.replace(models=models, agents=agents)

    def rollouts(
        self, counters: Counters, real: Float[Array, "C F"], model: Model, policy: Params, key: PRNGKeyArray
    ) -> trpo.Rollouts:
        """Rollouts of the policy in the model's mean, from real states; one that terminates begins again from another.
        Their observations are whitened, as policy and value function take them.

        SLBO's code starts them from the environment's initial states, which a model cannot draw.
        """
        settings, spec = self.settings, self.spec
        count, length = settings.policy_rollouts, settings.policy_rollout_length
        predict = partial(dynamics.predict, net=self.model_net, spec=spec, sampled=False)

        def real_states(key):
            return imagination.start_states(real, counters.env_steps, key, count, spec)

        def seen(obs):
            return _whitened(model.scaling, obs)

        def step(obs, xs):
            t, key = xs
            action_key, model_key, fresh_key = jax.random.split(key, 3)
            action = self.nets.policy.distribution(policy, seen(obs)).sample(action_key)
            answer = predict(model, obs, jnp.clip(action, -1.0, 1.0), model_key)
            ended = answer.terminated | (t == length - 1)
            terminated = answer.terminated.astype(jnp.float32)
            row = trpo.Rollouts(seen(obs), action, answer.reward, seen(answer.next_obs), terminated, ended)
            return jnp.where(answer.terminated[:, None], real_states(fresh_key), answer.next_obs), row

        start_key, step_key = jax.random.split(key)
        xs = jnp.arange(length), jax.random.split(step_key, length)
        return jax.lax.scan(step, real_states(start_key), xs)[1]

    def work(self, learning: np.ndarray, refreshes: np.ndarray) -> tuple[int, int]:
        settings = self.settings
        updates = len(refreshes) * settings.rounds * settings.policy_steps
        return updates, updates * settings.policy_rollouts * settings.policy_rollout_length


def _whitened(scaling: Scaling, obs: jax.Array) -> jax.Array:
    """Observations [..., O] as policy and value function take them."""
    size = obs.shape[-1]
    return (obs - scaling.input_mean[:size]) / scaling.input_std[:size]
