"""PS-MBPO and OPS-MBPO (Algorithm 1) for one seed: N models, N·M policies, one of which acts.

MBPO and SAC are settings of it: one policy that learns in all models (`rollout_models=any`), and one that learns from
real data alone (λ = 1, equation 15). They share every line, so that comparisons differ in the posterior only.
"""

from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from vecpsmbpo import feedforward, health, imagination, mixing, posterior, replay, sac
from vecpsmbpo.algorithms.base import Algorithm
from vecpsmbpo.algorithms.ps_mbpo.settings import PsMbpoSettings
from vecpsmbpo.feedforward import Feedforward
from vecpsmbpo.sac import Agent
from vecpsmbpo.types import Counters, Flag, Hyper, Number, Params, Posterior, SeedState, Transition, Whole


class PsMbpoState(struct.PyTreeNode):
    """What choices are made by, besides the returns of members; None where it is not asked for.

    Attributes:
        starts: [K, O], the first observations of the last K episodes (`weights=values`).
        bandit: which chooses λ (`real_ratio_schedule=bandit`).
    """

    starts: jax.Array | None
    bandit: mixing.Bandit | None


class PsMbpo(Algorithm):
    """Policies that learn by SAC from real and imagined data."""

    settings: PsMbpoSettings

    @cached_property
    def nets(self) -> sac.Networks:
        return sac.make_networks(self.settings, self.spec)

    def init_agent(self, key: PRNGKeyArray) -> Agent:
        return sac.init(key, self.nets, self.spec)

    @property
    def ring_capacity(self) -> int:
        return imagination.ring_capacity(self.settings) if self.settings.imagines else 0

    def retained_rows(self, env_steps: Whole) -> Whole:
        return imagination.retained_rows(self.settings, env_steps)

    def working_bytes(self, row: int) -> int:
        """Minibatches of a step, or rows in flight of a rollout."""
        settings = self.settings
        minibatches = 3 * settings.updates_per_step * settings.policy_batch_size * row
        if not settings.imagines:
            return minibatches
        return max(minibatches, imagination.batch_size(settings) * (2 * row + 8 * settings.model_hidden_size))

    def init(self, key: PRNGKeyArray, hyper: Hyper) -> SeedState:
        state, settings = super().init(key, hyper), self.settings
        if settings.weighs_values:
            unknown = jnp.zeros(settings.n_members)  # no episode has begun yet
            starts = jnp.zeros((posterior.STARTS, self.spec.obs_size))
            state = state.replace(episode=state.episode.replace(values=unknown))
        else:
            starts = None
        return state.replace(own=PsMbpoState(starts, mixing.init(settings) if settings.adapts_real_ratio else None))

    def numbers(self, counters: Counters, state: SeedState) -> dict[str, Any]:
        """λ, of several members their mean, and τ; where λ is chosen online, how likely each is the best."""
        bandit = state.own.bandit
        ratio = np.asarray(self.real_ratios(counters, state), np.float64).mean()
        chosen = {} if bandit is None else {"real_ratio_probs": mixing.probabilities(bandit)}
        return {"real_ratio": ratio, "temperature": state.hyper.temperature, **chosen}

    # ── who acts: once an episode ────────────────────────────────────────────────────────────────────────────

    def draw(
        self, earned: Posterior, values: Float[Array, " members"] | None, hyper: Hyper, key: PRNGKeyArray
    ) -> tuple[Int[Array, ""], Float[Array, " members"]]:
        """A member by equation 18 or 19; with `posterior=average` none, -1."""
        member, probs = posterior.draw(posterior.logits(earned, values, hyper.temperature), key)
        return jnp.int32(-1) if self.settings.averages_members else member, probs

    def credit(self, state: SeedState, episode_return: Number, enabled: Flag) -> SeedState:
        """To the member (equation 19) and, where λ is chosen online, to the λ that it learned with."""
        bandit = state.own.bandit
        if bandit is not None:
            arm = mixing.arms_of_members(self.settings, bandit)[state.episode.member]
            credited = mixing.credit(bandit, arm, episode_return)
            known = jax.tree.map(partial(jnp.where, enabled), credited, bandit)
            state = state.replace(own=state.own.replace(bandit=known))
        return super().credit(state, episode_return, enabled)

    def note_start(self, state: SeedState, obs: Float[Array, " O"]) -> SeedState:
        starts = posterior.add_start(state.own.starts, state.episode, obs)
        return state.replace(own=state.own.replace(starts=starts))

    # ── act ──────────────────────────────────────────────────────────────────────────────────────────────────

    def choose(
        self, counters: Counters, state: SeedState, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """An action sampled from the policy of the episode's member, or with `posterior=average` from all members'."""
        actors = state.agents.actor
        if self.settings.averages_members:
            return self._of_mixture(actors, obs, key), ()
        return self._of_member(state.episode.member, actors, obs, key), ()

    def evaluation_policy(self, state: SeedState, key: PRNGKeyArray) -> Params:
        """Parameters for `evaluation_action`, by `eval_policy`: of the member that the posterior would pick now, of the
        member that has earned the most per episode, or of all members."""
        if self._evaluates_all:
            return state.agents.actor
        if self.settings.eval_policy == "best":
            member = posterior.best(state.posterior)
        else:
            member, _ = self.draw(state.posterior, self.values(state), state.hyper, key)
        return self.layout.select_member(member, state.agents.actor)

    def evaluation_action(
        self, policy: Params, step: Int[Array, ""], memory: Any, obs: Float[Array, "*batch O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, "*batch A"], Any]:
        """The mean action or a sample of it: of the member chosen; with `posterior=average` of a member drawn at every
        step, as `choose` does; with `eval_policy=average` the average of all members' mean actions."""
        sampled = self.settings.eval_actions == "sampled"
        if not self._evaluates_all:
            distribution = self.nets.actor.distribution(policy, obs)
            return (distribution.sample(key)[0] if sampled else distribution.mode()), ()
        if sampled or self.settings.eval_policy == "posterior":
            return self._of_mixture(policy, obs, key, sampled=sampled), ()
        modes = jax.vmap(lambda params: self.nets.actor.distribution(params, obs).mode())(policy)
        return self.layout.mean_over_members(modes), ()

    def feedforward(self, policy: Params) -> Feedforward:
        layers = feedforward.dense_layers(policy["params"]["ReluMLP_0"])
        return Feedforward(feedforward.first_outputs(layers, self.spec.action_size))

    def values(self, state: SeedState) -> Float[Array, " members"] | None:
        """min(Q_1, Q_2) of each member's mean action, averaged over the starts of the last episodes, without entropy.

        The paper offers value functions in place of accumulated returns (section 3.3, after Agarwal and Zhang, 2022):
        what a member expects to earn, in its own model's world, rather than what it has earned. Members are comparable
        since all are asked about the same states, the real starts; since the bonus that their soft critics have learned
        for the entropy of all later actions, α H (γ + γ² + …) of a policy at its target H, is taken away, whatever
        their α are; and since none may promise more or less than the rewards seen so far allow: a critic that runs away
        is not preferred for it.
        """
        starts = state.own.starts
        if starts is None:
            return None
        nets = self.nets
        begun = state.episode.index - (state.episode.length == 0)
        known = jnp.arange(posterior.STARTS) < begun
        discount, target_entropy = state.hyper.discount, state.hyper.target_entropy
        steps = 1 / jnp.maximum(1 - discount, 1e-6)  # 1 + γ + γ² + …

        def value(agent: Agent) -> jax.Array:
            action = nets.actor.distribution(agent.actor, starts).mode()
            q = jnp.minimum(*nets.critic.values(agent.critic, starts, action))
            bonus = jnp.exp(agent.log_alpha) * target_entropy * discount * steps
            return jnp.sum(jnp.where(known, q - bonus, 0.0)) / jnp.maximum(jnp.sum(known), 1)

        least, most = state.moments.lowest_reward * steps, state.moments.highest_reward * steps
        return jnp.clip(self.layout.all_members(jax.vmap(value)(state.agents)), least, most)

    def _of_member(
        self, member: jax.Array, actors: Params, obs: jax.Array, key: jax.Array, *, sampled: bool = True
    ) -> jax.Array:
        """[A] an action of one member: a sample, or its mean."""

        def action(params: Params) -> jax.Array:
            distribution = self.nets.actor.distribution(params, obs)
            return distribution.sample(key)[0] if sampled else distribution.mode()

        return self.layout.select_member(member, actors, action)

    def _of_mixture(self, actors: Params, obs: jax.Array, key: jax.Array, *, sampled: bool = True) -> jax.Array:
        """[A] an action of the average of all members' action distributions (figure 6), their mixture with equal
        weights: a member drawn anew at every step, and its action. (Averaging the actions instead would take one that
        none of them considers good, wherever they disagree.)"""
        key, member_key = jax.random.split(key)
        member = jax.random.randint(member_key, (), 0, self.settings.n_members)
        return self._of_member(member, actors, obs, key, sampled=sampled)

    @property
    def _evaluates_all(self) -> bool:
        # Nobody earns anything where all act together: there is no best member either, and all are it.
        return self.settings.averages_members or self.settings.eval_policy == "average"

    # ── refresh: every `model_update_every` steps ────────────────────────────────────────────────────────────

    def real_ratios(self, counters: Counters, state: SeedState) -> Float[Array, " members"]:
        """The λ of each member now."""
        return mixing.real_ratios(self.settings, state.hyper, state.own.bandit, counters.env_steps)

    def refreshes(self, counters: Counters, state: SeedState) -> Bool[Array, ""]:
        """Whether any member may learn from imagined data in the period that begins: λ may fall from 1 within
        it, and what is then drawn from must be there. Who learns from real data alone (λ = 1, equation 15) needs no
        models."""
        if self.settings.adapts_real_ratio or not self.settings.imagines:
            return jnp.bool_(self.settings.imagines)  # any member may move to any λ
        last = counters._replace(env_steps=counters.env_steps + self.settings.model_update_every)
        return jnp.any(self.real_ratios(last, state) < 1)

    def refresh(
        self, counters: Counters, state: SeedState, enabled: Bool[Array, ""], key: PRNGKeyArray
    ) -> tuple[Counters, SeedState]:
        """Refits the models and renews the imagined data (Algorithm 1, lines 2 and 8 to 10)."""
        if not self.settings.imagines:
            return counters, state
        fit_key, imagine_key = jax.random.split(key)
        state = self.fit_models(counters, state, enabled, fit_key)
        return self.imagine(counters, state, enabled, imagine_key)

    def imagine(
        self, counters: Counters, state: SeedState, enabled: Bool[Array, ""], key: PRNGKeyArray
    ) -> tuple[Counters, SeedState]:
        """Rolls every member (n, m) out in model n from real states (lines 9 and 10), into its own ring.

        Adds as many rows to every ring: a row whose rollout terminates goes on from a fresh real state, so
        that shapes stay fixed and every stored row is valid. Rows that are not finite, of a model or policy beyond
        help, are stored as zeros, and the lane is frozen before anything is kept that was learned from them.
        """
        settings, spec, layout = self.settings, self.spec, self.layout
        batch = imagination.batch_size(settings)
        horizon = imagination.horizon(settings, counters.env_steps)
        batches = jnp.where(enabled, imagination.batches_per_refresh(settings, horizon), 0)
        ids = layout.member_ids()
        shared = settings.rollout_models == "any"
        models = (layout.all_models_for_members if shared else layout.models_of_members)(state.models)

        def real_states(keys):
            """[P_local] -> [P_local, batch, O]; for all members at once, as `learn` draws minibatches."""
            draw = partial(imagination.start_states, state.real, counters.env_steps, count=batch, spec=spec)
            return jax.vmap(draw)(keys)

        imagined_step = partial(imagination.step, net=self.model_net, nets=self.nets, settings=settings, spec=spec)

        def advance(model, actor, obs, fresh, key):
            transition = imagined_step(model, actor, obs, key)
            return replay.pack(transition), jnp.where(transition.terminated[:, None], fresh, transition.next_obs)

        def step(t, carry):
            imagined, sound, obs, added, key = carry
            keys = jax.vmap(jax.random.split)(layout.keys(jax.random.fold_in(key, t), ids))
            fresh = real_states(keys[:, 1])
            rows, obs = layout.map_local(advance, models, state.agents.actor, obs, fresh, keys[:, 0])
            finite = jnp.all(jnp.isfinite(rows), axis=-1)
            imagined = replay.add(imagined, jnp.where(finite[..., None], rows, 0.0), added)
            return imagined, sound & jnp.all(finite, axis=-1), obs, added + batch, key

        def rollout(c, carry):
            imagined, sound, added = carry
            start_key, step_key = jax.random.split(jax.random.fold_in(key, c))
            obs = real_states(layout.keys(start_key, ids))
            imagined, sound, _, added, _ = jax.lax.fori_loop(0, horizon, step, (imagined, sound, obs, added, step_key))
            return imagined, sound, added

        start = (state.imagined, jnp.ones(ids.shape, bool), counters.imagined_rows)
        imagined, sound, added = jax.lax.fori_loop(0, batches, rollout, start)
        counters = counters._replace(imagined_rows=replay.wrapped(added, self.ring_capacity))
        sound |= ids >= layout.n_members
        first = layout.least_of_members(jnp.min(jnp.where(sound, layout.n_members, ids)))
        noted = health.note(state.health, health.IMAGINED, first < layout.n_members, first)
        return counters, state.replace(imagined=imagined, health=noted)

    # ── learn: every step ────────────────────────────────────────────────────────────────────────────────────

    def learn(self, counters: Counters, state: SeedState, key: PRNGKeyArray) -> Agent:
        """The agents after G SAC updates of every member on λ D_E + (1 - λ) D_M^{n,m} (lines 11 and 12)."""
        settings, layout, nets = self.settings, self.layout, self.nets
        batch_key, update_key = jax.random.split(key)
        ids = layout.member_ids()
        ratios = self.real_ratios(counters, state)[ids % settings.n_members]  # of padding members, too
        # Minibatches of all members are gathered at once and before the loop over members: looping over the rings
        # themselves would copy each of them whole.
        batches = jax.vmap(lambda imagined, ratio, key: self.minibatches(counters, state, imagined, ratio, key))(
            state.imagined, ratios, layout.keys(batch_key, ids)
        )
        shape = (settings.updates_per_step, settings.policy_batch_size, self.spec.action_size)
        noise = jax.vmap(partial(sac.Noise.draw, shape=shape))(layout.keys(update_key, ids))
        batches, noise = layout.part((batches, noise), axis=2)

        def update(agent, batches, noise, hyper):
            return sac.updates(agent, batches, noise, hyper, nets=nets, mean=layout.mean_of_parts)

        hyper = sac.cooled(state.hyper, settings, counters.env_steps)
        return layout.map_local(update, state.agents, batches, noise, shared=(hyper,))

    def work(self, learning: np.ndarray, refreshes: np.ndarray) -> tuple[int, int]:
        settings = self.settings
        updates = len(learning) * settings.updates_per_step * settings.n_members
        if not settings.imagines:
            return updates, 0
        rows = imagination.rows_per_refresh(settings, jnp.asarray(refreshes))
        return updates, int(np.sum(rows)) * settings.n_members

    def minibatches(
        self,
        counters: Counters,
        state: SeedState,
        imagined: Float[Array, "C_M F"] | None,
        real_ratio: Number,
        key: PRNGKeyArray,
    ) -> Transition:
        """G minibatches, each row real with probability λ, on its own (footnote 2).

        Args:
            imagined: the member's ring; or None, where nobody learns from imagined data.
        """
        shape = (self.settings.updates_per_step, self.settings.policy_batch_size)
        source_key, real_key, imagined_key = jax.random.split(key, 3)
        real_index = replay.sample_indices(real_key, shape, counters.env_steps, state.real.shape[0])
        if imagined is None:
            return self._unpack(state.real[real_index])
        newest = self.retained_rows(counters.env_steps)
        imagined_index = replay.sample_newest_indices(
            imagined_key, shape, counters.imagined_rows, imagined.shape[0], newest
        )
        from_real = jax.random.uniform(source_key, shape) < real_ratio
        rows = jnp.where(from_real[..., None], state.real[real_index], imagined[imagined_index])
        return self._unpack(rows)
