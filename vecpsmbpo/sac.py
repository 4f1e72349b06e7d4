"""ONE soft actor-critic agent (A.2, equations 22 to 29): init, act, update.

As in Acme, and as the paper says: twin Q functions and no value network, so that V in equations 24 and 29 is
min(Q_1, Q_2) - α log π under the target critic; the entropy coefficient α is learned.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, PRNGKeyArray

from vecpsmbpo import networks, optim
from vecpsmbpo.settings.parts import SacSettings
from vecpsmbpo.types import EnvSpec, Hyper, Number, Params, Stats, Transition, Whole

LEAST_RATE = 0.05  # the share of the learning rate that a cooldown ends at


class SacStats(Stats):
    """What an update reports."""

    critic_loss: jax.Array
    actor_loss: jax.Array
    alpha: jax.Array
    q_mean: jax.Array
    entropy: jax.Array


class Agent(struct.PyTreeNode):
    """Networks, target, entropy coefficient α, and the state of Adam for each."""

    actor: Params
    critic: Params
    target_critic: Params
    log_alpha: jax.Array
    actor_optimizer: Any
    critic_optimizer: Any
    alpha_optimizer: Any
    stats: SacStats


class Networks(NamedTuple):
    actor: networks.Actor
    critic: networks.TwinCritic


class Noise(NamedTuple):
    """What the actions of an update are drawn with: standard normal, [..., B, A] each, at s' and at s."""

    next_action: jax.Array
    action: jax.Array

    @classmethod
    def draw(cls, key: PRNGKeyArray, shape: tuple[int, ...]) -> "Noise":
        return cls(*jax.random.normal(key, (2, *shape)))


def make_networks(settings: SacSettings, spec: EnvSpec) -> Networks:
    """Of every member: obs [..., O] -> a distribution over actions [..., A], and Q_1, Q_2 [...] of the two."""
    size, layers = settings.policy_hidden_size, settings.policy_hidden_layers
    precision = settings.network_precision
    return Networks(
        actor=networks.Actor(spec.action_size, size, layers, precision),
        critic=networks.TwinCritic(size, layers, settings.critic_norm, precision),
    )


def init(key: PRNGKeyArray, nets: Networks, spec: EnvSpec) -> Agent:
    """A member drawn at random, with target critics equal to the critics and α = 1."""
    actor_key, critic_key = jax.random.split(key)
    obs, action = jnp.zeros(spec.obs_size), jnp.zeros(spec.action_size)
    actor, critic = nets.actor.init(actor_key, obs), nets.critic.init(critic_key, obs, action)
    log_alpha = jnp.zeros(())
    return Agent(
        actor=actor,
        critic=critic,
        target_critic=critic,
        log_alpha=log_alpha,
        actor_optimizer=optim.init(actor),
        critic_optimizer=optim.init(critic),
        alpha_optimizer=optim.init(log_alpha),
        stats=SacStats.zero(),
    )


def target_value(
    reward: Float[Array, "*batch"],
    terminated: Float[Array, "*batch"],
    next_q: Float[Array, "*batch"],
    next_log_prob: Float[Array, "*batch"],
    alpha: Number,
    discount: Number,
) -> Float[Array, "*batch"]:
    """r + γ (1 - terminated) (Q̄(s', a') - α log π(a' | s')) (equations 23, 24 and 29).

    A truncated transition has terminated = 0 and bootstraps.
    """
    return reward + discount * (1 - terminated) * (next_q - alpha * next_log_prob)


def critic_loss(
    critic: Params,
    agent: Agent,
    batch: Transition,
    discount: Number,
    noise: Float[Array, "B A"],
    *,
    nets: Networks,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """½ (Q - Q̂)² for both critics (equation 27), and the mean of Q over the batch."""
    next_action, next_log_prob = nets.actor.distribution(agent.actor, batch.next_obs).reparameterized(noise)
    next_q = jnp.minimum(*nets.critic.values(agent.target_critic, batch.next_obs, next_action))
    alpha = jnp.exp(agent.log_alpha)
    target = target_value(batch.reward, batch.terminated, next_q, next_log_prob, alpha, discount)
    first, second = nets.critic.values(critic, batch.obs, batch.action)
    return 0.5 * jnp.mean((first - target) ** 2 + (second - target) ** 2), jnp.mean(first)


def actor_loss(
    actor: Params,
    critic: Params,
    alpha: Number,
    obs: Float[Array, "B O"],
    noise: Float[Array, "B A"],
    *,
    nets: Networks,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """E[α log π(a | s) - min Q(s, a)] (equations 25 and 28), and the mean log-probability."""
    action, log_prob = nets.actor.distribution(actor, obs).reparameterized(noise)
    q = jnp.minimum(*nets.critic.values(critic, obs, action))
    return jnp.mean(alpha * log_prob - q), jnp.mean(log_prob)


def update(
    agent: Agent,
    batch: Transition,
    noise: Noise,
    hyper: Hyper,
    *,
    nets: Networks,
    mean: Callable[[Any], Any] = lambda parts: parts,
) -> Agent:
    """One gradient step of critic, actor and α, and one of the target critic's average.

    Args:
        batch: leaves [B, ...].
        mean: of losses and gradients over the parts of a minibatch that lies on several devices.
    """
    rate = hyper.policy_learning_rate

    alpha = jnp.exp(agent.log_alpha)
    critic_value_and_grad = jax.value_and_grad(critic_loss, has_aux=True)
    (loss_q, q_mean), critic_gradient = mean(
        critic_value_and_grad(agent.critic, agent, batch, hyper.discount, noise.next_action, nets=nets)
    )
    critic, critic_optimizer = optim.step(critic_gradient, agent.critic_optimizer, agent.critic, rate)

    actor_value_and_grad = jax.value_and_grad(actor_loss, has_aux=True)
    (loss_pi, log_prob), actor_gradient = mean(
        actor_value_and_grad(agent.actor, critic, alpha, batch.obs, noise.action, nets=nets)
    )
    actor, actor_optimizer = optim.step(actor_gradient, agent.actor_optimizer, agent.actor, rate)

    # ∂/∂(log α) of E[-α (log π + target entropy)]: entropy below its target raises α.
    alpha_gradient = -alpha * (log_prob + hyper.target_entropy)
    log_alpha, alpha_optimizer = optim.step(alpha_gradient, agent.alpha_optimizer, agent.log_alpha, rate)

    # Not optax.incremental_update, which rounds both of its products: an average moves by less than they are wrong.
    target_critic = jax.tree.map(
        lambda average, new: average + hyper.target_update_rate * (new - average), agent.target_critic, critic
    )
    news = SacStats(
        updates=jnp.ones(()),
        critic_loss=loss_q,
        actor_loss=loss_pi,
        alpha=alpha,
        q_mean=q_mean,
        entropy=-log_prob,
    )
    return Agent(
        actor=actor,
        critic=critic,
        target_critic=target_critic,
        log_alpha=log_alpha,
        actor_optimizer=actor_optimizer,
        critic_optimizer=critic_optimizer,
        alpha_optimizer=alpha_optimizer,
        stats=jax.tree.map(jnp.add, agent.stats, news),
    )


def cooled(hyper: Hyper, settings: SacSettings, env_steps: Whole) -> Hyper:
    """With the learning rate of now: constant, but for a cooldown at the end of the run, in which it falls on a line to
    `LEAST_RATE` of it. (Hägele et al., 2024, call it that, and find it as good as a rate that falls from the start.)"""
    if not settings.policy_learning_rate_cooldown:
        return hyper
    length = settings.policy_learning_rate_cooldown * settings.total_steps
    left = jnp.clip((settings.total_steps - env_steps) / length, LEAST_RATE, 1.0)
    return hyper.replace(policy_learning_rate=hyper.policy_learning_rate * left)


def updates(agent: Agent, batches: Transition, noise: Noise, hyper: Hyper, **how: Any) -> Agent:
    """G updates in a row.

    Args:
        batches, noise: leaves [G, B, ...].
        how: the keywords of `update`.
    """

    def body(agent, xs):
        batch, noise = xs
        return update(agent, batch, noise, hyper, **how), None

    return jax.lax.scan(body, agent, (batches, noise))[0]
