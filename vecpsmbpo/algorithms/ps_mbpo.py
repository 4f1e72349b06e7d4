"""PS-MBPO and OPS-MBPO (Algorithm 1) for one seed: N models, N·M policies, one of which acts.

MBPO and SAC are settings of it: one policy that learns in all models (`rollout_models=any`), and one that learns from
real data alone (λ = 1, equation 15). They share every line, so that comparisons differ in the posterior only.

Everything here runs inside `layout.Layout.spread`: models and agents are this device's share, [N_local, ...] and
[P_local, ...]. `counters` are shared by all seeds.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from vecpsmbpo import dynamics, imagination, mixture, posterior, replay, sac
from vecpsmbpo.layout import Layout
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import (
    Agent,
    Counters,
    EnvSpec,
    Episode,
    EpisodeEnd,
    Hyper,
    Moments,
    Params,
    SeedState,
    Transition,
)


@dataclass(frozen=True)
class PsMbpo:
    """The algorithm's functions over fixed shapes."""

    settings: Settings
    spec: EnvSpec
    layout: Layout

    # ── init ─────────────────────────────────────────────────────────────────────────────────────────────────

    def init(self, key: jax.Array, hyper: Hyper) -> SeedState:
        """The state before the first step. The first episode is a warm-up episode."""
        settings, spec, layout = self.settings, self.spec, self.layout
        nets = sac.make_networks(settings, spec)
        key, model_key, agent_key, draw_key = jax.random.split(key, 4)
        members = posterior.init(settings.n_members)
        size = spec.obs_size + spec.action_size
        ring = replay.init(imagination.ring_capacity(settings), spec.obs_size, spec.action_size)
        return SeedState(
            key=key,
            hyper=hyper,
            models=jax.vmap(lambda k: dynamics.init(k, hyper, settings, spec))(
                layout.keys(model_key, layout.model_ids())
            ),
            agents=jax.vmap(lambda k: sac.init(k, nets, spec))(layout.keys(agent_key, layout.member_ids())),
            real=replay.init(settings.replay_capacity, spec.obs_size, spec.action_size),
            imagined=jnp.broadcast_to(ring, (layout.member_ids().shape[0], *ring.shape)),
            moments=Moments(mean=jnp.zeros(size), deviation=jnp.zeros(size)),
            posterior=members,
            episode=self._begin_episode(members, hyper, jnp.int32(1), jnp.bool_(True), draw_key),
            bandit=mixture.init(settings, jax.random.fold_in(draw_key, 2)) if settings.adapts_real_ratio else None,
            epoch_return=jnp.zeros(()),
            epoch_episodes=jnp.zeros(()),
        )

    # ── act ──────────────────────────────────────────────────────────────────────────────────────────────────

    def act(self, state: SeedState, obs: jax.Array, key: jax.Array) -> jax.Array:
        """The running episode's action: sampled from its member's policy, or uniform in a random episode.

        With `posterior=average` (figure 6) from the average of all members' action distributions, their mixture with
        equal weights: a member drawn anew at every step, and its action. (Averaging the actions instead would take one
        that none of them considers good, wherever they disagree.)

        Shapes: obs [O] -> action [A].
        """
        policy_key, uniform_key = jax.random.split(key)
        actor = sac.make_networks(self.settings, self.spec).actor
        member = state.episode.member
        if self.settings.posterior == "average":
            member = jax.random.randint(jax.random.fold_in(key, 1), (), 0, self.settings.n_members)
        action = self.layout.ask(
            member,
            state.agents.actor,
            lambda params: actor.law(params, obs).sample(policy_key)[0],
        )
        uniform = jax.random.uniform(uniform_key, action.shape, minval=-1.0, maxval=1.0)
        return jnp.where(state.episode.random, uniform, action)

    def evaluation_policy(self, state: SeedState, key: jax.Array) -> Params:
        """Parameters for `act_greedily`, by `eval_policy`: of the member that the posterior would pick now, of the
        member that has earned the most, or of all members."""
        if self._evaluates_average:
            return state.agents.actor
        scores = posterior.logits(state.posterior, state.hyper.temperature)
        drawn, _ = posterior.draw(state.posterior, state.hyper.temperature, key)
        member = jnp.argmax(scores) if self.settings.eval_policy == "best" else drawn
        return self.layout.ask(member, state.agents.actor)

    def act_greedily(self, policy: Params, obs: jax.Array) -> jax.Array:
        """Mean action of the evaluation policy; for `average`, averaged over the members. obs [O] -> [A]."""
        actor = sac.make_networks(self.settings, self.spec).actor
        if self._evaluates_average:
            actions = jax.vmap(lambda params: actor.law(params, obs).mode())(policy)
            return self.layout.mean_over_members(actions)
        return actor.law(policy, obs).mode()

    @property
    def _evaluates_average(self) -> bool:
        chosen = self.settings.eval_policy
        return chosen == "average" or (chosen == "posterior" and self.settings.posterior == "average")

    # ── observe ──────────────────────────────────────────────────────────────────────────────────────────────

    def observe(
        self,
        counters: Counters,
        state: SeedState,
        transition: Transition,
        truncated: jax.Array,
        key: jax.Array,
    ) -> tuple[SeedState, EpisodeEnd]:
        """Stores a real transition; where it ends the episode, credits the member and draws the next one."""
        episode = state.episode
        total = episode.episode_return + transition.reward
        length = episode.length + 1
        terminated = transition.terminated > 0
        done = terminated | truncated
        end = EpisodeEnd(
            done=done,
            index=episode.index,
            member=episode.member,
            random=episode.random,
            terminated=terminated,
            episode_return=total,
            length=length,
            probs=episode.probs,
        )
        members = posterior.credit(state.posterior, episode.member, total, done & ~episode.random)
        random = counters.env_steps + 1 < self.settings.warmup_steps
        following = self._begin_episode(members, state.hyper, episode.index + 1, random, key)
        running = episode.replace(episode_return=total, length=length)
        state = state.replace(
            real=replay.add(state.real, replay.pack(transition)[None], counters.env_steps),
            moments=_welford(state.moments, transition, counters.env_steps),
            posterior=members,
            episode=jax.tree.map(lambda a, b: jnp.where(done, a, b), following, running),
            epoch_return=state.epoch_return + jnp.where(done, total, 0.0),
            epoch_episodes=state.epoch_episodes + done,
        )
        return state, end

    def _begin_episode(self, members, hyper: Hyper, index, random, key: jax.Array) -> Episode:
        member, probs = posterior.draw(members, hyper.temperature, key)
        if self.settings.posterior == "average":
            member = jnp.int32(-1)
        explores = posterior.exploration_probability(hyper.forced_exploration, index)
        random |= jax.random.bernoulli(jax.random.fold_in(key, 1), explores)
        zero = jnp.zeros(())
        return Episode(index, member, random, probs, episode_return=zero, length=jnp.int32(0))

    # ── refresh: every `model_update_every` steps ────────────────────────────────────────────────────────────

    def real_ratio(self, counters: Counters, state: SeedState) -> jax.Array:
        """λ now, []."""
        return mixture.real_ratio(self.settings, state.hyper, state.bandit, counters.env_steps)

    def begin_epoch(self, counters: Counters, state: SeedState, key: jax.Array) -> SeedState:
        """Clears the epoch's sums when an epoch begins, and lets the bandit, if there is one, draw λ anew."""
        settings = self.settings
        fresh = counters.env_steps % settings.epoch_steps == 0
        if state.bandit is not None:
            counts = fresh & (counters.env_steps > settings.first_learning_step) & (state.epoch_episodes > 0)
            mean_return = state.epoch_return / jnp.maximum(state.epoch_episodes, 1)
            drawn = mixture.end_round(state.bandit, settings, mean_return, key)
            state = state.replace(bandit=jax.tree.map(partial(jnp.where, counts), drawn, state.bandit))

        def cleared(tree):
            return jax.tree.map(lambda x: jnp.where(fresh, jnp.zeros_like(x), x), tree)

        return state.replace(
            agents=state.agents.replace(stats=cleared(state.agents.stats)),
            epoch_return=cleared(state.epoch_return),
            epoch_episodes=cleared(state.epoch_episodes),
        )

    def fit_models(self, counters: Counters, state: SeedState, enabled: jax.Array, key: jax.Array) -> SeedState:
        """Refits every model on D_E (Algorithm 1, line 2) where `enabled`."""
        settings, spec = self.settings, self.spec
        split_key, fit_key = jax.random.split(key)
        rows = counters.env_steps
        split = dynamics.Split.draw(split_key, rows, settings.replay_capacity, settings.validation_block)
        whitening = dynamics.scaling(state.moments, rows)

        def fit(model, key):
            return dynamics.fit(model, state.real, split, whitening, state.hyper, key, settings=settings, spec=spec)

        keys = self.layout.keys(fit_key, self.layout.model_ids())
        # Only the models go through the branch: see `drivers.observe_and_learn`.
        fitted = jax.lax.cond(
            enabled, lambda models: self.layout.map_local(fit, models, keys), lambda x: x, state.models
        )
        return state.replace(models=fitted)

    def imagine(self, counters: Counters, state: SeedState, enabled: jax.Array, key: jax.Array) -> SeedState:
        """Rolls every member (n, m) out in model n from real states (lines 9 and 10), into its own ring.

        Adds `imagined_rows` rows to every ring: a row whose rollout terminates goes on from a fresh real state, so
        that shapes stay fixed and every stored row is valid.
        """
        settings, spec, layout = self.settings, self.spec, self.layout
        chunk = imagination.chunk_size(settings)
        horizon = imagination.horizon(settings, counters.env_steps)
        chunks = jnp.where(enabled, imagination.chunks_per_refresh(settings, horizon), 0)
        ids = layout.member_ids()
        shared = settings.rollout_models == "any"
        models = (layout.all_models_for_members if shared else layout.models_of_members)(state.models)

        def real_states(key):
            return imagination.start_states(state.real, counters.env_steps, key, chunk, spec)

        def advance(model, actor, obs, key):
            step_key, fresh_key = jax.random.split(key)
            transition = imagination.step(model, actor, obs, step_key, settings=settings, spec=spec)
            ended = transition.terminated[:, None]
            return replay.pack(transition), jnp.where(ended, real_states(fresh_key), transition.next_obs)

        def step(t, carry):
            imagined, obs, rows, key = carry
            rows_now, obs = layout.map_local(
                advance, models, state.agents.actor, obs, layout.keys(jax.random.fold_in(key, t), ids)
            )
            return replay.add(imagined, rows_now, rows), obs, rows + chunk, key

        def rollout(c, carry):
            imagined, rows = carry
            start_key, step_key = jax.random.split(jax.random.fold_in(key, c))
            obs = jax.vmap(real_states)(layout.keys(start_key, ids))
            imagined, _, rows, _ = jax.lax.fori_loop(0, horizon, step, (imagined, obs, rows, step_key))
            return imagined, rows

        imagined, _ = jax.lax.fori_loop(0, chunks, rollout, (state.imagined, counters.imagined_rows))
        return state.replace(imagined=imagined)

    def imagined_rows(self, counters: Counters, enabled: jax.Array) -> jax.Array:
        """The counter of `counters` after `imagine`."""
        new = jnp.where(enabled, imagination.rows_per_refresh(self.settings, counters.env_steps), 0)
        return replay.count(counters.imagined_rows, new, imagination.ring_capacity(self.settings))

    # ── learn: every step ────────────────────────────────────────────────────────────────────────────────────

    def learn(self, counters: Counters, state: SeedState, key: jax.Array) -> Agent:
        """The agents after G SAC updates of every member on λ D_E + (1 - λ) D_M^{n,m} (lines 11 and 12)."""
        layout, nets = self.layout, sac.make_networks(self.settings, self.spec)
        batch_key, update_key = jax.random.split(key)
        ids = layout.member_ids()
        # Minibatches of all members are gathered at once and before the loop over members: looping over the rings
        # themselves would copy each of them whole.
        batches = jax.vmap(lambda imagined, key: self.minibatches(counters, state, imagined, key))(
            state.imagined, layout.keys(batch_key, ids)
        )

        def update(agent, batches, key):
            return sac.updates(agent, batches, state.hyper, key, nets=nets)

        return layout.map_local(update, state.agents, batches, layout.keys(update_key, ids))

    def minibatches(self, counters: Counters, state: SeedState, imagined: jax.Array, key: jax.Array) -> Transition:
        """G minibatches, each row real with probability λ, on its own (footnote 2). imagined: [C_M, F]."""
        shape = (self.settings.updates_per_step, self.settings.policy_batch_size)
        source_key, real_key, imagined_key = jax.random.split(key, 3)
        real_index = replay.sample_indices(real_key, shape, counters.env_steps, state.real.shape[0])
        newest = imagination.retained_rows(self.settings, counters.env_steps)
        imagined_index = replay.sample_newest_indices(
            imagined_key, shape, counters.imagined_rows, imagined.shape[0], newest
        )
        from_real = jax.random.uniform(source_key, shape) < self.real_ratio(counters, state)
        rows = jnp.where(from_real[..., None], state.real[real_index], imagined[imagined_index])
        return replay.unpack(rows, self.spec.obs_size, self.spec.action_size)


def _welford(moments: Moments, transition: Transition, rows: jax.Array) -> Moments:
    """Moments of one more row after `rows` of them."""
    value = jnp.concatenate([transition.obs, transition.action])
    change = value - moments.mean
    mean = moments.mean + change / (rows + 1)
    return Moments(mean=mean, deviation=moments.deviation + change * (value - mean))
