"""ONE policy learned by trust-region policy optimization (Schulman et al., 2015), with GAE (the same, 2016)."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.scipy.sparse.linalg import cg
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vecpsmbpo import optim
from vecpsmbpo.algorithms.slbo import networks
from vecpsmbpo.algorithms.slbo.settings import SlboSettings
from vecpsmbpo.types import EnvSpec, Number, Params, Stats

DAMPING = 0.1  # added to the Fisher matrix
CG_ITERATIONS = 10
LINE_SEARCH_STEPS = 10  # each half as long as the one before
VALUE_STEPS, VALUE_BATCH, VALUE_RATE = 20, 256, 1e-3  # of Adam, after each step of the policy

Samples = tuple[Float[Array, "K O"], Float[Array, "K A"], Float[Array, " K"]]  # observations, actions, advantages


class TrpoStats(Stats):
    """What an update reports."""

    critic_loss: jax.Array
    actor_loss: jax.Array
    q_mean: jax.Array
    entropy: jax.Array


class TrpoAgent(struct.PyTreeNode):
    """Policy and value function; Adam's state of the latter."""

    policy: Params
    value: Params
    value_optimizer: Any
    stats: TrpoStats


class Rollouts(NamedTuple):
    """T steps of B rollouts, in order.

    Attributes:
        obs, next_obs: [T, B, O]; action [T, B, A], before it is clipped.
        reward, terminated: [T, B].
        ended: [T, B] bool, the row after this one belongs to another rollout.
    """

    obs: jax.Array
    action: jax.Array
    reward: jax.Array
    next_obs: jax.Array
    terminated: jax.Array
    ended: jax.Array


class Networks(NamedTuple):
    policy: networks.GaussianPolicy
    value: networks.StateValue


def make_networks(settings: SlboSettings, spec: EnvSpec) -> Networks:
    """Whitened obs [..., O] -> a Gaussian over actions [..., A], and a value [...]."""
    size, layers = settings.policy_hidden_size, settings.policy_hidden_layers
    return Networks(networks.GaussianPolicy(spec.action_size, size, layers), networks.StateValue(size, layers))


def init(key: PRNGKeyArray, nets: Networks, spec: EnvSpec) -> TrpoAgent:
    """A policy and its value function, drawn at random."""
    policy_key, value_key = jax.random.split(key)
    obs = jnp.zeros(spec.obs_size)
    value = nets.value.init(value_key, obs)
    return TrpoAgent(nets.policy.init(policy_key, obs), value, optim.init(value), TrpoStats.zero())


def advantages(
    reward: Float[Array, "T B"],
    value: Float[Array, "T B"],
    next_value: Float[Array, "T B"],
    terminated: Float[Array, "T B"],
    ended: Bool[Array, "T B"],
    discount: Number,
    decay: float,
) -> Float[Array, "T B"]:
    """Generalized advantages Σ_l (γ λ)^l δ_{t+l} within a rollout, where δ = r + γ (1 - terminated) V(s') - V(s)."""
    delta = reward + discount * (1 - terminated) * next_value - value

    def backwards(following, xs):
        delta, ended = xs
        advantage = delta + discount * decay * (1 - ended) * following
        return advantage, advantage

    return jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, ended.astype(delta.dtype)), reverse=True)[1]


def surrogate(
    policy: Params, old_log_prob: Float[Array, " K"], samples: Samples, entropy_weight: float, *, nets: Networks
) -> Float[Array, ""]:
    """E[π / π_old · advantage] and the entropy bonus."""
    obs, action, advantage = samples
    distribution = nets.policy.distribution(policy, obs)
    ratio = jnp.exp(distribution.log_prob(action) - old_log_prob)
    return jnp.mean(ratio * advantage) + entropy_weight * jnp.mean(distribution.entropy())


def divergence(policy: Params, old: Params, obs: Float[Array, "K O"], *, nets: Networks) -> Float[Array, ""]:
    """Mean KL(π_old || π) over `obs`."""
    return jnp.mean(nets.policy.distribution(old, obs).divergence_to(nets.policy.distribution(policy, obs)))


def natural_direction(
    policy: Params, gradient: Float[Array, " D"], obs: Float[Array, "K O"], *, nets: Networks
) -> tuple[Float[Array, " D"], Any]:
    """(F + damping)⁻¹ gradient by conjugate gradients, and F + damping as a function; F is the Hessian of the KL.

    gradient: of the parameters as one vector.
    """
    flat, unravel = ravel_pytree(policy)
    slope = jax.grad(lambda x: divergence(unravel(x), policy, obs, nets=nets))

    def fisher(vector):
        return jax.jvp(slope, (flat,), (vector,))[1] + DAMPING * vector

    return cg(fisher, gradient, maxiter=CG_ITERATIONS, tol=1e-8)[0], fisher


def policy_step(
    policy: Params, samples: Samples, *, trust_region: float, entropy_weight: float, nets: Networks
) -> tuple[Params, Float[Array, ""]]:
    """The policy after one step that improves the surrogate and stays within the trust region, or the same policy where
    no step of the line search does; and by how much the surrogate grew.
    """
    flat, unravel = ravel_pytree(policy)
    old_log_prob = nets.policy.distribution(policy, samples[0]).log_prob(samples[1])

    def objective(x):
        return surrogate(unravel(x), old_log_prob, samples, entropy_weight, nets=nets)

    before, gradient = jax.value_and_grad(objective)(flat)
    direction, fisher = natural_direction(policy, gradient, samples[0], nets=nets)
    longest = jnp.sqrt(2 * trust_region / jnp.maximum(direction @ fisher(direction), 1e-10))

    def candidate(step):
        return flat + 0.5**step * longest * direction

    def fails(x):
        too_far = divergence(unravel(x), policy, samples[0], nets=nets) > trust_region
        return too_far | ~(objective(x) > before)

    steps = jax.lax.while_loop(
        lambda step: (step < LINE_SEARCH_STEPS) & fails(candidate(step)), lambda step: step + 1, 0
    )
    chosen = jnp.where(steps < LINE_SEARCH_STEPS, candidate(steps), flat)
    return unravel(chosen), objective(chosen) - before


def update(
    agent: TrpoAgent, rollouts: Rollouts, discount: Number, key: PRNGKeyArray, *, settings: SlboSettings, nets: Networks
) -> TrpoAgent:
    """One step of the policy, and the value function refitted to the rollouts' returns."""
    value, next_value = (nets.value.values(agent.value, obs) for obs in (rollouts.obs, rollouts.next_obs))
    advantage = advantages(
        rollouts.reward, value, next_value, rollouts.terminated, rollouts.ended, discount, settings.gae_decay
    )
    flat = lambda x: x.reshape(-1, *x.shape[2:])  # noqa: E731
    obs, target = flat(rollouts.obs), flat(advantage + value)
    scaled = (flat(advantage) - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    policy, gain = policy_step(
        agent.policy,
        (obs, flat(rollouts.action), scaled),
        trust_region=settings.trust_region,
        entropy_weight=settings.entropy_weight,
        nets=nets,
    )

    def value_step(carry, key):
        params, optimizer = carry
        chosen = jax.random.randint(key, (VALUE_BATCH,), 0, obs.shape[0])
        error = lambda params: jnp.mean((nets.value.values(params, obs[chosen]) - target[chosen]) ** 2)  # noqa: E731
        loss, gradient = jax.value_and_grad(error)(params)
        return optim.step(gradient, optimizer, params, VALUE_RATE), loss

    start = agent.value, agent.value_optimizer
    (fitted, optimizer), losses = jax.lax.scan(value_step, start, jax.random.split(key, VALUE_STEPS))
    news = TrpoStats(
        updates=jnp.ones(()),
        critic_loss=jnp.mean(losses),
        actor_loss=-gain,
        q_mean=jnp.mean(value),
        entropy=jnp.mean(nets.policy.distribution(policy, obs).entropy()),
    )
    return TrpoAgent(policy, fitted, optimizer, jax.tree.map(jnp.add, agent.stats, news))
