"""What every algorithm does: keep the real data, the models and the episodes, and decide who acts.

Everything here runs inside `layout.Layout.jit_shard_map`: models and agents are this device's share, [N_local, ...] and
[P_local, ...]. `counters` are shared by all seeds.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from vecpsmbpo import dynamics, health, moments, posterior, replay
from vecpsmbpo.feedforward import Feedforward
from vecpsmbpo.layout import Layout
from vecpsmbpo.networks import GaussianMLP
from vecpsmbpo.settings import Settings
from vecpsmbpo.settings.parts import FitSettings
from vecpsmbpo.types import (
    Counters,
    EnvSpec,
    Episode,
    EpisodeEnd,
    Flag,
    Hyper,
    Number,
    Posterior,
    SeedState,
    Transition,
    Whole,
    possible,
)


@dataclass(frozen=True)
class Algorithm(ABC):
    """An algorithm's functions over fixed shapes, for one seed."""

    settings: Settings
    spec: EnvSpec
    layout: Layout

    @cached_property
    def model_net(self) -> GaussianMLP:
        """The network of every dynamics model."""
        return dynamics.network(self.settings, self.spec)

    # ── what an algorithm adds ───────────────────────────────────────────────────────────────────────────────

    @abstractmethod
    def init_agent(self, key: PRNGKeyArray) -> Any:
        """One member; its sums over an epoch are in its `stats` (`types.Stats`)."""

    @abstractmethod
    def choose(
        self, counters: Counters, state: SeedState, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """The acting member's action, and what it will remember at the episode's next step."""

    @abstractmethod
    def evaluation_policy(self, state: SeedState, key: PRNGKeyArray) -> Any:
        """What `evaluation_action` needs of the state."""

    @abstractmethod
    def evaluation_action(
        self, policy: Any, step: Int[Array, ""], memory: Any, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """The action at a step of an evaluation episode, from 0, and what it will remember."""

    @abstractmethod
    def refresh(
        self, counters: Counters, state: SeedState, enabled: Bool[Array, ""], key: PRNGKeyArray
    ) -> tuple[Counters, SeedState]:
        """What happens where a period of `model_update_every` steps begins; nothing where not `enabled`. The counters
        must not depend on the seed's state."""

    @abstractmethod
    def work(self, learning: np.ndarray, refreshes: np.ndarray) -> tuple[int, int]:
        """How many gradient steps and imagined rows there are in the steps `learning`, which learn and of which
        `refreshes` begin with a refresh; of all members together. For the display of speeds."""

    def feedforward(self, policy: Any) -> Feedforward | None:
        """The mean action that `evaluation_action` gives of `policy`, of one member, as matrices on the host; None
        where it is not one network's."""
        return None

    def working_bytes(self, row: int) -> int:
        """Of the largest temporaries of one member; a transition takes `row` of them."""
        return 0

    def memory(self) -> Any:
        """What is remembered when an episode begins."""
        return ()

    @property
    def nets(self) -> Any:
        """The networks of a member, or None where it has none."""
        return None

    def numbers(self, counters: Counters, state: SeedState) -> dict[str, Any]:
        """What it has to say in an epoch's line of metrics.jsonl besides the members' `stats`: numbers, and lists of
        them, by name. Called on the host, with NumPy arrays, and without key, models, agents and rings."""
        return {}

    def values(self, state: SeedState) -> Float[Array, " members"] | None:
        """What each member promises, where `weights=values`, or None."""
        return None

    def draw(
        self, earned: Posterior, values: Float[Array, " members"] | None, hyper: Hyper, key: PRNGKeyArray
    ) -> tuple[Int[Array, ""], Float[Array, " members"]]:
        """Who acts in the episode that begins, and the distribution that it was drawn from (line 3).

        Args:
            earned: by each member.
            values: of each, or None.
        """
        return jnp.int32(0), jnp.ones(self.settings.n_members)

    def credit(self, state: SeedState, episode_return: Number, enabled: Flag) -> SeedState:
        """What the episode that ends earned, where `enabled`: added to what is known of the member that acted
        (line 15)."""
        credited = posterior.credit(state.posterior, state.episode.member, episode_return, enabled)
        return state.replace(posterior=credited)

    def refreshes(self, counters: Counters, state: SeedState) -> Bool[Array, ""]:
        """Whether there is anything to refresh for in the period that begins."""
        return jnp.bool_(True)

    def note_start(self, state: SeedState, obs: Float[Array, " O"]) -> SeedState:
        """Keeps what the algorithm wants of the observation that a step of the running episode begins with."""
        return state

    @property
    def ring_capacity(self) -> int:
        """C_M: rows that are imagined for a member and kept; 0 where none are."""
        return 0

    def retained_rows(self, env_steps: Whole) -> Whole:
        """How many of the newest rows that were imagined for a member it learns from after `env_steps` steps."""
        return 0

    def learn(self, counters: Counters, state: SeedState, key: PRNGKeyArray) -> Any:
        """The agents after what is learned at every step."""
        return state.agents

    # ── init ─────────────────────────────────────────────────────────────────────────────────────────────────

    def init(self, key: PRNGKeyArray, hyper: Hyper) -> SeedState:
        """The state before the first step. The first episode is a warm-up episode."""
        settings, spec, layout = self.settings, self.spec, self.layout
        key, model_key, agent_key, draw_key = jax.random.split(key, 4)
        earned = posterior.init(settings.n_members)
        ring = replay.init(self.ring_capacity, spec.obs_size, spec.action_size)
        rings = jnp.broadcast_to(ring, (layout.member_ids().shape[0], *ring.shape))
        return SeedState(
            key=key,
            hyper=hyper,
            models=jax.vmap(lambda k: dynamics.init(k, hyper, net=self.model_net, settings=settings, spec=spec))(
                layout.keys(model_key, layout.model_ids())
            ),
            agents=jax.vmap(self.init_agent)(layout.keys(agent_key, layout.member_ids())),
            real=replay.init(settings.replay_capacity, spec.obs_size, spec.action_size),
            newest=jnp.zeros(ring.shape[1:]),
            imagined=rings if self.ring_capacity else None,
            moments=moments.init(spec.obs_size, spec.action_size),
            posterior=earned,
            episode=self._begin_episode(earned, None, hyper, jnp.int32(1), jnp.int32(1), jnp.bool_(True), draw_key),
            memory=self.memory(),
            own=(),
            epoch_return=jnp.zeros(()),
            epoch_episodes=jnp.zeros(()),
            epoch_unsound=jnp.zeros(()),
            health=health.init(),
        )

    # ── act ──────────────────────────────────────────────────────────────────────────────────────────────────

    def act(
        self, counters: Counters, state: SeedState, obs: Float[Array, " O"], key: PRNGKeyArray
    ) -> tuple[Float[Array, " A"], Any]:
        """The running episode's action, uniform in a random episode, and what is to be remembered."""
        policy_key, uniform_key = jax.random.split(key)
        obs = jnp.where(possible(obs), obs, 0.0)  # a simulator's mistake must not become the policy's
        action, memory = self.choose(counters, state, obs, policy_key)
        return jnp.where(state.episode.random, self._random_action(state, uniform_key), action), memory

    def _random_action(self, state: SeedState, key: PRNGKeyArray) -> jax.Array:
        """Uniform, [A]; drawn anew at every `random_hold`-th step of an episode, at others that of the step before."""
        action = jax.random.uniform(key, (self.spec.action_size,), minval=-1.0, maxval=1.0)
        if self.settings.random_hold == 1:
            return action
        drawn = state.episode.length % self.settings.random_hold == 0
        return jnp.where(drawn, action, self._unpack(state.newest).action)

    # ── observe ──────────────────────────────────────────────────────────────────────────────────────────────

    def observe(
        self,
        counters: Counters,
        state: SeedState,
        transition: Transition,
        truncated: Bool[Array, ""],
        key: PRNGKeyArray,
    ) -> tuple[SeedState, EpisodeEnd]:
        """Stores a real transition (line 7); where it ends the episode, credits the member (line 15) and draws who acts
        in the next one (lines 1 and 3).

        Where something in it is not possible (`types.possible`), the episode ends before it, truncated, with the
        return so far.
        """
        row, sound = self._row(state, transition)
        stored = self._unpack(row)
        end = _news(state.episode, transition, truncated, sound)
        state = state.replace(  # line 7
            real=replay.add(state.real, row[None], counters.env_steps),
            newest=row,
            moments=moments.add(state.moments, stored, counters.env_steps),
        )
        state = self.credit(state, end.episode_return, end.done & ~end.random)  # line 15
        state = self.note_start(state, jnp.where(possible(transition.obs), transition.obs, stored.obs))
        random = counters.env_steps + 1 < self.settings.warmup_steps
        state = self._go_on(state, end, random, key)  # lines 1 and 3
        state = state.replace(
            epoch_return=state.epoch_return + jnp.where(end.done, end.episode_return, 0.0),
            epoch_episodes=state.epoch_episodes + end.done,
            epoch_unsound=state.epoch_unsound + ~sound,
            health=health.note(state.health, health.ACTION, ~jnp.all(jnp.isfinite(transition.action))),
        )
        return state, end

    def _row(self, state: SeedState, transition: Transition) -> tuple[jax.Array, jax.Array]:
        """The row [F] to store for a transition, and whether it is the transition: [] bool.

        One that is not possible is never stored. Since every seed adds a row per step, the last good one is stored
        again; at a run's very first step there is none, and it is a row of zeros.
        """
        row = replay.pack(transition)
        sound = jnp.all(possible(row))
        return jnp.where(sound, row, state.newest), sound

    def _unpack(self, rows: jax.Array) -> Transition:
        return replay.unpack(rows, self.spec.obs_size, self.spec.action_size)

    def _go_on(self, state: SeedState, end: EpisodeEnd, random: Flag, key: PRNGKeyArray) -> SeedState:
        """The running episode, or where it has ended the next one, whose actions are `random` within the warm-up."""
        running = state.episode.replace(episode_return=end.episode_return, length=end.length)
        values = self.values(state.replace(episode=running))
        index, warmups = running.index + 1, running.warmups + random
        following = self._begin_episode(state.posterior, values, state.hyper, index, warmups, random, key)
        return state.replace(
            episode=jax.tree.map(partial(jnp.where, end.done), following, running),
            memory=jax.tree.map(partial(jnp.where, end.done), self.memory(), state.memory),
        )

    def _begin_episode(
        self,
        earned: Posterior,
        values: jax.Array | None,
        hyper: Hyper,
        index: Int[Array, ""],
        warmups: Int[Array, ""],
        random: Flag,
        key: PRNGKeyArray,
    ) -> Episode:
        member, probs = self.draw(earned, values, hyper, key)
        after_warmup = jnp.maximum(index - warmups, 1)
        explores = posterior.exploration_probability(hyper.forced_exploration, after_warmup)
        random |= jax.random.bernoulli(jax.random.fold_in(key, 1), explores)
        zero = jnp.zeros(())
        return Episode(index, warmups, member, random, probs, values, episode_return=zero, length=jnp.int32(0))

    # ── where a stride begins ────────────────────────────────────────────────────────────────────────────────

    def begin_epoch(self, counters: Counters, state: SeedState) -> SeedState:
        """Clears the epoch's sums when an epoch begins."""
        fresh = counters.env_steps % self.settings.epoch_steps == 0

        def cleared(tree):
            return jax.tree.map(lambda x: jnp.where(fresh, jnp.zeros_like(x), x), tree)

        return state.replace(
            agents=state.agents.replace(stats=cleared(state.agents.stats)),
            epoch_return=cleared(state.epoch_return),
            epoch_episodes=cleared(state.epoch_episodes),
            epoch_unsound=cleared(state.epoch_unsound),
        )

    def fit_models(
        self, counters: Counters, state: SeedState, enabled: Bool[Array, ""], key: PRNGKeyArray
    ) -> SeedState:
        """Refits every model on D_E (Algorithm 1, line 2) where `enabled`."""
        settings = self.settings
        assert isinstance(settings, FitSettings)  # of an algorithm that asks for this
        split_key, fit_key = jax.random.split(key)
        added = counters.env_steps
        split = dynamics.Split.draw(split_key, added, settings.replay_capacity, settings.validation_block)
        scaling = dynamics.scaling(state.moments, added, settings)
        how: dict[str, Any] = {"net": self.model_net, "settings": settings, "spec": self.spec}

        def fit(model, key, real, split, scaling, hyper):
            return dynamics.fit(model, real, split, scaling, hyper, key, **how)

        def fitted(models):
            keys = self.layout.keys(fit_key, self.layout.model_ids())
            return self.layout.map_local(fit, models, keys, shared=(state.real, split, scaling, state.hyper))

        # Only the models go through the branch: see `schedule.observe_and_learn`.
        return state.replace(models=jax.lax.cond(enabled, fitted, lambda models: models, state.models))


def _news(episode: Episode, transition: Transition, truncated: Flag, sound: Flag) -> EpisodeEnd:
    """Of the step that `transition` is; its reward counts where it is `sound`."""
    terminated = (transition.terminated > 0) & sound
    return EpisodeEnd(
        done=terminated | truncated | ~sound,
        index=episode.index,
        member=episode.member,
        random=episode.random,
        terminated=terminated,
        episode_return=episode.episode_return + jnp.where(sound, transition.reward, 0.0),
        length=episode.length + 1,
        probs=episode.probs,
        values=episode.values,
    )
