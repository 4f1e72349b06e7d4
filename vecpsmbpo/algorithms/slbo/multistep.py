"""SLBO's fit of ONE dynamics model (Luo et al., 2019, section 4): several steps ahead, in a norm not squared."""

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vecpsmbpo import dynamics, networks, optim, replay
from vecpsmbpo.algorithms.slbo.settings import SlboSettings
from vecpsmbpo.types import EnvSpec, Hyper, Model, Transition, Whole


def loss(
    model: Model, batch: Transition, follows: Bool[Array, "B H"], *, net: networks.GaussianMLP
) -> Float[Array, ""]:
    """Mean over h of ‖((ŝ_{h+1} - ŝ_h) - (s_{h+1} - s_h)) / σ_s, r̂_h - r_h‖, where ŝ_0 = s_0 and the model goes on from
    its own predictions.

    The state counts in units of the standard deviations that whiten it; SLBO's code divides likewise. Where
    termination is learned, its cross-entropy is added.

    Args:
        batch: H consecutive rows, leaves [B, H, ...].
        follows: whether the row continues the one before it; the rest of a broken sequence does not count.
    """
    obs_size = batch.obs.shape[-1]

    def ahead(obs, h):
        prediction = dynamics.forward(model, obs, batch.action[:, h], net=net)
        change, reward = prediction.mean[:, :-1], prediction.mean[:, -1]
        error = (change - (batch.next_obs[:, h] - batch.obs[:, h])) / model.scaling.input_std[:obs_size]
        squared = jnp.sum(error**2, axis=-1) + (reward - batch.reward[:, h]) ** 2
        return obs + change, jnp.sqrt(squared + 1e-12)  # the root of 0 has no slope

    unbroken = jnp.cumprod(follows, axis=-1)
    obs, total = batch.obs[:, 0], jnp.zeros(())
    for h in range(batch.reward.shape[-1]):
        obs, distance = ahead(obs, h)
        total += jnp.sum(distance * unbroken[:, h])
    value = total / jnp.sum(unbroken)
    logit = dynamics.forward(model, batch.obs[:, 0], batch.action[:, 0], net=net).logit
    if logit is not None:
        value += jnp.mean(optax.sigmoid_binary_cross_entropy(logit, batch.terminated[:, 0]))
    return value


def sequences(
    real: Float[Array, "C F"], added: Whole, key: PRNGKeyArray, settings: SlboSettings, spec: EnvSpec
) -> tuple[Transition, Bool[Array, "B H"]]:
    """A batch of H consecutive rows of D_E, leaves [B, H, ...], and where each continues the one before.

    Rows do not say where episodes end; a row continues another when it starts where that one led.
    """
    capacity, length = real.shape[0], settings.model_steps_ahead
    start = replay.sample_indices(key, (settings.model_batch_size,), added - length + 1, capacity)
    batch = replay.unpack(real[(start[:, None] + jnp.arange(length)) % capacity], spec.obs_size, spec.action_size)
    continues = jnp.all(batch.obs[:, 1:] == batch.next_obs[:, :-1], axis=-1)
    return batch, jnp.concatenate([jnp.ones_like(continues[:, :1]), continues], axis=-1)


def fit(
    model: Model,
    real: Float[Array, "C F"],
    added: Whole,
    hyper: Hyper,
    key: PRNGKeyArray,
    *,
    net: networks.GaussianMLP,
    settings: SlboSettings,
    spec: EnvSpec,
) -> Model:
    """The model after `model_steps` of Adam. real: D_E, of which `added` rows were added."""

    def step(carry, key):
        params, optimizer = carry
        batch, follows = sequences(real, added, key, settings, spec)
        objective = lambda params: loss(model.replace(params=params), batch, follows, net=net)  # noqa: E731
        value, gradient = jax.value_and_grad(objective)(params)
        return optim.step(gradient, optimizer, params, hyper.model_learning_rate, decay=hyper.model_weight_decay), value

    start = model.params, model.optimizer
    (params, optimizer), losses = jax.lax.scan(step, start, jax.random.split(key, settings.model_steps))
    return model.replace(params=params, optimizer=optimizer, loss=jnp.mean(losses))
