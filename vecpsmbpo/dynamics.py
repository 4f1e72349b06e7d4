"""ONE dynamics model: loss (equation 17), fit with early stopping, prediction (equations 20 and 21)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from vecpsmbpo import networks, optim, replay
from vecpsmbpo.settings import Settings
from vecpsmbpo.settings.parts import FitSettings
from vecpsmbpo.types import EnvSpec, Hyper, Model, Moments, Params, Prior, Scaling, Transition, Whole

VALIDATION_BATCH = 512


class Split(NamedTuple):
    """A random split of the first `added` rows of D_E into training and validation.

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
    def draw(cls, key: PRNGKeyArray, added: Whole, capacity: int, block: int) -> "Split":
        offset = jax.random.randint(key, (-(-capacity // block),), 0, block)
        return cls(offset, jnp.minimum(added, capacity) // block)

    def train_rows(self, key: PRNGKeyArray, batch: int, block: int) -> Int[Array, " {batch}"]:
        """Indices of training rows, uniform with replacement."""
        which, member = jax.random.split(key)
        chosen = jax.random.randint(which, (batch,), 0, jnp.maximum(self.blocks, 1))
        shift = jax.random.randint(member, (batch,), 1, block)  # anything but the validating row
        return chosen * block + (self.offset[chosen] + shift) % block

    def validation_rows(
        self, start: Whole, batch: int, block: int
    ) -> tuple[Int[Array, " {batch}"], Bool[Array, " {batch}"]]:
        """Validation rows `start` to `start + batch`: their indices, and which of them exist."""
        chosen = start + jnp.arange(batch)
        exists = chosen < self.blocks
        chosen = jnp.where(exists, chosen, 0)
        return chosen * block + self.offset[chosen], exists


def network(settings: Settings, spec: EnvSpec) -> networks.GaussianMLP:
    """[..., O + A], whitened -> Gaussians of (Δs, r) [..., O + 1]; where nobody knows the task's rule of termination,
    its logit, too."""
    return networks.GaussianMLP(
        output_size=spec.obs_size + 1,
        hidden_size=settings.model_hidden_size,
        hidden_layers=settings.model_hidden_layers,
        predicts_termination=spec.terminated is None,
        precision=settings.network_precision,
    )


def init(key: PRNGKeyArray, hyper: Hyper, *, net: networks.GaussianMLP, settings: Settings, spec: EnvSpec) -> Model:
    """Drawn at random, a prior as well where there is one, and without units (`scaling`) until the first fit."""
    size, zero = spec.obs_size + spec.action_size, jnp.zeros(())
    params = net.init(key, jnp.zeros(size))
    prior = None
    if settings.has_prior:
        prior = Prior(net.init(jax.random.fold_in(key, 1), jnp.zeros(size)), hyper.prior_scale)
    plain = Scaling(jnp.zeros(size), jnp.ones(size), jnp.ones(spec.obs_size + 1))
    validated = isinstance(settings, FitSettings)
    return Model(params, optim.init(params), plain, loss=zero, val_mse=zero if validated else None, prior=prior)


def scaling(moments: Moments, added: Whole, settings: Settings) -> Scaling:
    """What whitens the inputs (equation 20) and, with `whiten_targets`, the outputs: changes Δs and rewards.

    What has never varied is left unscaled: there is nothing to learn of it yet, and dividing by a vanishing deviation
    would turn its first change into an explosion.
    """
    std = jnp.sqrt(moments.deviation / jnp.maximum(added, 1))
    std = jnp.where(std > 1e-6, std, 1.0)
    size = moments.inputs
    outputs = std[size:] if settings.whiten_targets else jnp.ones_like(std[size:])
    return Scaling(moments.mean[:size], std[:size], outputs)


def forward(
    model: Model, obs: Float[Array, "*batch O"], action: Float[Array, "*batch A"], *, net: networks.GaussianMLP
) -> networks.Prediction:
    """What the model says of (Δs, r) (equations 20 and 34)."""
    scaling = model.scaling
    inputs = (jnp.concatenate([obs, action], axis=-1) - scaling.input_mean) / scaling.input_std
    prior: Any = 0.0
    if model.prior is not None:
        prior = model.prior.scale * net.apply(model.prior.params, inputs, method=net.outputs)
    prediction: Any = net.apply(model.params, inputs, scaling.output_std, prior)
    return prediction


class Successor(NamedTuple):
    """What follows in the model: next_obs [..., O], reward [...], terminated [...] bool."""

    next_obs: jax.Array
    reward: jax.Array
    terminated: jax.Array


def predict(
    model: Model,
    obs: Float[Array, "*batch O"],
    action: Float[Array, "*batch A"],
    key: PRNGKeyArray,
    *,
    net: networks.GaussianMLP,
    spec: EnvSpec,
    sampled: bool = True,
) -> Successor:
    """A draw of (s', r) ~ N((s + Δs, r), σ²) (equation 21), or the mean of that where it is not `sampled`; and whether
    it ends the episode: by the task's own rule, or drawn with the learned probability where that is not known.
    """
    prediction = forward(model, obs, action, net=net)
    outputs = prediction.mean
    if sampled:
        outputs += jnp.exp(0.5 * prediction.log_variance) * jax.random.normal(key, outputs.shape)
    next_obs, reward = obs + outputs[..., :-1], outputs[..., -1]
    if spec.terminated is not None:
        return Successor(next_obs, reward, spec.terminated(obs, action, next_obs))
    terminates = jax.random.bernoulli(jax.random.fold_in(key, 1), jax.nn.sigmoid(prediction.logit))
    return Successor(next_obs, reward, terminates)


def negative_log_likelihood(
    mean: Float[Array, "*batch"], log_variance: Float[Array, "*batch"], target: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """Equation 17 without its constant: log σ² / 2 + (y - μ)² / (2 σ²)."""
    return 0.5 * log_variance + 0.5 * (target - mean) ** 2 * jnp.exp(-log_variance)


def _targets(batch: Transition) -> jax.Array:
    """(Δs, r), [B, O + 1]."""
    return jnp.concatenate([batch.next_obs - batch.obs, batch.reward[:, None]], axis=-1)


class Beta(NamedTuple):
    """By how much what is poorly predicted still counts (`loss`): of changes Δs, and of the reward, each in [0, 1]."""

    changes: float
    reward: float

    @classmethod
    def of(cls, settings: FitSettings) -> "Beta":
        return cls(settings.nll_beta, settings.reward_nll_beta)


def loss(model: Model, batch: Transition, *, net: networks.GaussianMLP, beta: Beta) -> Float[Array, ""]:
    """Equation 17, averaged over rows and outputs; where termination is learned, plus its cross-entropy.

    The gradient of equation 17 in μ is (μ - y) / σ²: what a model is still wrong about, and knows to be, hardly counts
    beside what it already predicts well, and may stay wrong for ever. With β each term counts σ^(2β) times, σ in units
    of the model's outputs (Seitzer et al. 2022, "On the pitfalls of heteroscedastic uncertainty estimation with
    probabilistic neural networks", equation 9): 0 is equation 17, 1 has the gradient of the squared error in μ.

    Args:
        batch: leaves [B, ...].
    """
    prediction = forward(model, batch.obs, batch.action, net=net)
    terms = negative_log_likelihood(prediction.mean, prediction.log_variance, _targets(batch))
    if any(beta):
        log_variance = jax.lax.stop_gradient(prediction.log_variance) - 2 * jnp.log(model.scaling.output_std)
        powers = jnp.full(terms.shape[-1], beta.changes).at[-1].set(beta.reward)
        terms *= jnp.exp(powers * log_variance)
    value = jnp.mean(terms)
    if prediction.logit is not None:
        value += jnp.mean(optax.sigmoid_binary_cross_entropy(prediction.logit, batch.terminated))
    return value


def validation_error(
    model: Model,
    rows_of: Callable[[Int[Array, " B"]], Transition],
    split: Split,
    block: int,
    *,
    net: networks.GaussianMLP,
) -> Float[Array, ""]:
    """Mean squared error over the validation rows, in units of the model's outputs, in batches of a fixed size;
    where termination is learned, plus its cross-entropy.

    Args:
        rows_of: indices [B] -> the rows of D_E, leaves [B, ...].
    """

    def add_batch(index, total):
        rows, exists = split.validation_rows(index * VALIDATION_BATCH, VALIDATION_BATCH, block)
        batch = rows_of(rows)
        prediction = forward(model, batch.obs, batch.action, net=net)
        error = jnp.mean(((prediction.mean - _targets(batch)) / model.scaling.output_std) ** 2, axis=-1)
        if prediction.logit is not None:
            error += optax.sigmoid_binary_cross_entropy(prediction.logit, batch.terminated)
        return total + jnp.sum(jnp.where(exists, error, 0.0))

    batches = -(-split.blocks // VALIDATION_BATCH)
    return jax.lax.fori_loop(0, batches, add_batch, 0.0) / jnp.maximum(split.blocks, 1)


def fit(
    model: Model,
    real: Float[Array, "C F"],
    split: Split,
    scaling: Scaling,
    hyper: Hyper,
    key: PRNGKeyArray,
    *,
    net: networks.GaussianMLP,
    settings: FitSettings,
    spec: EnvSpec,
) -> Model:
    """Trains until validation error has not fallen by `model_improvement` for `model_patience` epochs; keeps the
    parameters of least error.

    What the fit begins with does not compete: it has seen most rows of the new validation set. Nor must an epoch pass
    the threshold to be kept: where a task's impacts dominate the error, everything else that can be learned is less.

    Every trip count is traced: one compiled program serves a data set of any size.

    Args:
        real: D_E.
        split: which of its rows train and which validate.
        scaling: of its rows.
    """
    block = settings.validation_block
    model = model.replace(scaling=scaling)

    def rows_of(indices: jax.Array) -> Transition:
        return replay.unpack(real[indices], spec.obs_size, spec.action_size)

    def step(params: Params, optimizer: Any, key: jax.Array):
        batch = rows_of(split.train_rows(key, settings.model_batch_size, block))
        objective = lambda params: loss(model.replace(params=params), batch, net=net, beta=Beta.of(settings))  # noqa: E731
        value, gradient = jax.value_and_grad(objective)(params)
        rate, decay = hyper.model_learning_rate, hyper.model_weight_decay
        return *optim.step(gradient, optimizer, params, rate, decay=decay), value

    def validate(params: Params) -> jax.Array:
        return validation_error(model.replace(params=params), rows_of, split, block, net=net)

    steps_per_epoch = -(-split.blocks * (block - 1) // settings.model_batch_size)

    def epoch(carry):
        params, optimizer, best_params, best, mark, stale, count, _ = carry

        def body(index, inner):
            params, optimizer, total = inner
            step_key = jax.random.fold_in(jax.random.fold_in(key, count), index)
            params, optimizer, value = step(params, optimizer, step_key)
            return params, optimizer, total + value

        params, optimizer, total = jax.lax.fori_loop(0, steps_per_epoch, body, (params, optimizer, 0.0))
        mse = validate(params)
        best_params = jax.tree.map(partial(jnp.where, mse < best), params, best_params)
        improved = mse < mark * (1 - settings.model_improvement)
        mark, stale = jnp.where(improved, mse, mark), jnp.where(improved, 0, stale + 1)
        train_loss = total / jnp.maximum(steps_per_epoch, 1)
        return params, optimizer, best_params, jnp.minimum(mse, best), mark, stale, count + 1, train_loss

    def unfinished(carry):
        *_, stale, count, _ = carry
        return (stale < settings.model_patience) & (count < settings.model_max_epochs)

    start = (model.params, model.optimizer, model.params, jnp.inf, jnp.inf, 0, 0, model.loss)
    _, optimizer, params, best, _, _, _, train_loss = jax.lax.while_loop(unfinished, epoch, start)
    return model.replace(params=params, optimizer=optimizer, loss=train_loss, val_mse=best)
