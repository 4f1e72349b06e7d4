"""ONE dynamics model: loss (equation 17), fit with early stopping, prediction (equations 20 and 21)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vecpsmbpo import networks, optim, replay
from vecpsmbpo.settings import Settings
from vecpsmbpo.types import EnvSpec, Hyper, Model, Moments, Params

VALIDATION_BATCH = 512


class Split(NamedTuple):
    """A random split of the first `rows` rows of D_E into training and validation.

    Of every k consecutive rows, row `offset` of that block validates and the other k - 1 train. This is exactly
    1/k of the data, drawn anew at every refit, and needs no permutation of a data set whose size is traced; the
    draw is stratified over time. The up to k - 1 newest rows beyond the last whole block wait for the next refit.

    Attributes:
        offset: [ceil(C / k)] int, in [0, k).
        blocks: [] int, whole blocks in the data.
    """

    offset: jax.Array
    blocks: jax.Array

    @classmethod
    def draw(cls, key: jax.Array, rows: jax.Array, capacity: int, block: int) -> "Split":
        offset = jax.random.randint(key, (-(-capacity // block),), 0, block)
        return cls(offset, jnp.minimum(rows, capacity) // block)

    def train_rows(self, key: jax.Array, batch: int, block: int) -> jax.Array:
        """[batch] indices of training rows, uniform with replacement."""
        which, member = jax.random.split(key)
        chosen = jax.random.randint(which, (batch,), 0, jnp.maximum(self.blocks, 1))
        shift = jax.random.randint(member, (batch,), 1, block)  # anything but the validating row
        return chosen * block + (self.offset[chosen] + shift) % block

    def validation_rows(self, start: jax.Array, batch: int, block: int) -> tuple[jax.Array, jax.Array]:
        """Validation rows `start` to `start + batch`: their indices, and which of them exist, [batch] each."""
        chosen = start + jnp.arange(batch)
        exists = chosen < self.blocks
        chosen = jnp.where(exists, chosen, 0)
        return chosen * block + self.offset[chosen], exists


def network(settings: Settings, spec: EnvSpec) -> networks.GaussianMLP:
    return networks.GaussianMLP(spec.obs_size + 1, settings.model_hidden_size, settings.model_hidden_layers)


def init(key: jax.Array, settings: Settings, spec: EnvSpec) -> Model:
    size = spec.obs_size + spec.action_size
    params = network(settings, spec).init(key, jnp.zeros(size))
    zero = jnp.zeros(())
    return Model(params, optim.init(params), jnp.zeros(size), jnp.ones(size), loss=zero, val_mse=zero)


def scaling(moments: Moments, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation [O + A] that whiten the inputs (equation 20).

    An input that has never varied is left unscaled: there is nothing to learn from it yet, and dividing by a
    vanishing deviation would turn its first change into an explosion.
    """
    std = jnp.sqrt(moments.deviation / jnp.maximum(rows, 1))
    return moments.mean, jnp.where(std > 1e-6, std, 1.0)


def forward(model: Model, obs: jax.Array, action: jax.Array, *, net: networks.GaussianMLP):
    """Mean and log-variance of (Δs, r), [..., O + 1] each (equation 20)."""
    inputs = jnp.concatenate([obs, action], axis=-1)
    return net.apply(model.params, (inputs - model.input_mean) / model.input_std)


def predict(model: Model, obs: jax.Array, action: jax.Array, key: jax.Array, *, net: networks.GaussianMLP):
    """A draw of (s', r) ~ N((s + Δs, r), σ²) (equation 21).

    Shapes: obs [..., O], action [..., A] -> next_obs [..., O], reward [...].
    """
    mean, log_variance = forward(model, obs, action, net=net)
    sample = mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
    return obs + sample[..., :-1], sample[..., -1]


def negative_log_likelihood(mean: jax.Array, log_variance: jax.Array, target: jax.Array) -> jax.Array:
    """Equation 17 without its constant, elementwise: log σ² / 2 + (y - μ)² / (2 σ²)."""
    return 0.5 * log_variance + 0.5 * (target - mean) ** 2 * jnp.exp(-log_variance)


def fit(
    model: Model,
    real: jax.Array,
    split: Split,
    whitening: tuple[jax.Array, jax.Array],
    hyper: Hyper,
    key: jax.Array,
    max_epochs: jax.Array,
    *,
    settings: Settings,
    spec: EnvSpec,
) -> Model:
    """Trains until validation error has not improved for `model_patience` epochs; keeps the best parameters.

    Every trip count is traced: one compiled program serves a data set of any size.

    Args:
        real: D_E, [C, F].
        split: which of its rows train and which validate.
        whitening: mean and standard deviation of the inputs, [O + A] each.
        max_epochs: [] int; 0 returns the model unchanged, apart from its whitening.
    """
    net, block = network(settings, spec), settings.validation_block
    model = model.replace(input_mean=whitening[0], input_std=whitening[1])

    def examples(indices):
        transition = replay.unpack(real[indices], spec.obs_size, spec.action_size)
        target = jnp.concatenate([transition.next_obs - transition.obs, transition.reward[:, None]], axis=-1)
        return transition.obs, transition.action, target

    def loss(params: Params, key: jax.Array) -> jax.Array:
        obs, action, target = examples(split.train_rows(key, settings.model_batch_size, block))
        mean, log_variance = forward(model.replace(params=params), obs, action, net=net)
        return jnp.mean(negative_log_likelihood(mean, log_variance, target))

    def step(carry, key):
        params, optimizer = carry
        value, gradient = jax.value_and_grad(loss)(params, key)
        # L2 in the gradient, as torch's Adam(weight_decay) of both MBPO codebases has it.
        gradient = jax.tree.map(lambda g, p: g + hyper.model_weight_decay * p, gradient, params)
        return optim.step(gradient, optimizer, params, hyper.model_learning_rate), value

    def validate(params: Params) -> jax.Array:
        def batch(index, total):
            rows, exists = split.validation_rows(index * VALIDATION_BATCH, VALIDATION_BATCH, block)
            obs, action, target = examples(rows)
            mean, _ = forward(model.replace(params=params), obs, action, net=net)
            return total + jnp.sum(jnp.where(exists, jnp.mean((mean - target) ** 2, axis=-1), 0.0))

        batches = -(-split.blocks // VALIDATION_BATCH)
        return jax.lax.fori_loop(0, batches, batch, 0.0) / jnp.maximum(split.blocks, 1)

    steps_per_epoch = -(-split.blocks * (block - 1) // settings.model_batch_size)

    def epoch(carry):
        params, optimizer, best_params, best, stale, count, _ = carry

        def body(index, inner):
            params, optimizer, total = inner
            step_key = jax.random.fold_in(jax.random.fold_in(key, count), index)
            (params, optimizer), value = step((params, optimizer), step_key)
            return params, optimizer, total + value

        params, optimizer, total = jax.lax.fori_loop(0, steps_per_epoch, body, (params, optimizer, 0.0))
        mse = validate(params)
        better = mse < best * (1 - settings.model_improvement)
        best_params = jax.tree.map(lambda new, old: jnp.where(better, new, old), params, best_params)
        best, stale = jnp.where(better, mse, best), jnp.where(better, 0, stale + 1)
        return params, optimizer, best_params, best, stale, count + 1, total / jnp.maximum(steps_per_epoch, 1)

    def unfinished(carry):
        *_, stale, count, _ = carry
        return (stale < settings.model_patience) & (count < max_epochs)

    start = (model.params, model.optimizer, model.params, validate(model.params), 0, 0, model.loss)
    _, optimizer, params, best, _, _, train_loss = jax.lax.while_loop(unfinished, epoch, start)
    return model.replace(params=params, optimizer=optimizer, loss=train_loss, val_mse=best)
