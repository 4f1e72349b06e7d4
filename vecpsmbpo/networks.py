"""The networks: dynamics (A.1), SAC's actor and twin critic (A.2)."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float, PRNGKeyArray

from vecpsmbpo.types import Params

MIN_LOG_VARIANCE, MAX_LOG_VARIANCE = -10.0, 2.0
MIN_SCALE = 1e-3  # Acme's floor under the standard deviation of the policy


class Precision(NamedTuple):
    """Of a network's products. Parameters are float32 always.

    Attributes:
        dtype: of hidden activations, and of what the layers between the first and the last multiply.
        products: of the other products, as XLA knows it; None is what the device does.
    """

    dtype: Any
    products: Any


PRECISIONS = {
    "default": Precision(jnp.float32, None),
    "float32": Precision(jnp.float32, jax.lax.Precision.HIGHEST),
    "bfloat16": Precision(jnp.bfloat16, jax.lax.Precision.HIGHEST),
}


def layer(size: int, kernel_init: Any, precision: str, *, inner: bool = False) -> nn.Dense:
    """A dense layer, of a `PRECISIONS` name. The first and the last of a network are float32 whatever that is, since
    bfloat16 cannot tell positions of 0.85 that are 4 mm apart, nor values of 100 that are half a unit apart."""
    dtype, products = PRECISIONS[precision]
    return nn.Dense(size, dtype=dtype if inner else jnp.float32, precision=products, kernel_init=kernel_init)


def hidden_layer(index: int, hidden: jax.Array, size: int, kernel_init: Any, precision: str) -> jax.Array:
    """What goes into the activation function of hidden layer `index`, from 0."""
    return layer(size, kernel_init, precision, inner=index > 0)(hidden).astype(PRECISIONS[precision].dtype)


model_init = nn.initializers.variance_scaling(1.0, "fan_in", "truncated_normal")
policy_init = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")


class Prediction(NamedTuple):
    """What a dynamics model says of (Δs, r), and, where it learns that, of termination.

    Attributes:
        mean, log_variance: [..., O + 1].
        logit: [...] of the probability that the episode terminates, or None.
    """

    mean: jax.Array
    log_variance: jax.Array
    logit: Any


class GaussianMLP(nn.Module):
    """Diagonal Gaussian over (Δs, r), with its log-variance softly clamped to [-10, 2] (A.1).

    Attributes:
        predicts_termination: one more output, for tasks whose termination rule is not known.
        precision: a name in `PRECISIONS`.
    """

    output_size: int
    hidden_size: int
    hidden_layers: int
    predicts_termination: bool = False
    precision: str = "default"

    @nn.compact
    def outputs(self, inputs: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """f_θ: inputs [..., O + A], whitened, to what the prediction is made of."""
        hidden = inputs
        for index in range(self.hidden_layers):
            hidden = nn.swish(hidden_layer(index, hidden, self.hidden_size, model_init, self.precision))
        return layer(2 * self.output_size + self.predicts_termination, model_init, self.precision)(hidden)

    def __call__(
        self,
        inputs: Float[Array, "*batch inputs"],
        scale: Float[Array, " predicted"] | float = 1.0,
        prior: Any = 0.0,
    ) -> Prediction:
        """The prediction of f_θ + prior, whose outputs are in units of `scale` [O + 1].

        inputs [..., O + A], whitened. In small units the variance may rise as far as in the plain ones.
        """
        outputs = self.outputs(inputs) + prior
        mean, log_variance, rest = jnp.split(outputs, [self.output_size, 2 * self.output_size], axis=-1)
        unit = 2 * jnp.log(scale)
        most = MAX_LOG_VARIANCE + jnp.maximum(-unit, 0.0)
        log_variance = most - nn.softplus(most - log_variance)
        log_variance = MIN_LOG_VARIANCE + nn.softplus(log_variance - MIN_LOG_VARIANCE)
        return Prediction(mean * scale, log_variance + unit, rest[..., 0] if self.predicts_termination else None)


def layer_norm(x: Float[Array, "*batch H"]) -> Float[Array, "*batch H"]:
    """Each row at mean 0 and variance 1 (Ba et al., 2016), without gain and offset, which the dense layers around it
    have."""
    return _standardized(x.astype(jnp.float32)).astype(x.dtype)


# Its sums are products with a column of ones, and its gradient is written out: so an update of 64 columns takes 1.17
# times the plain one on a CPU, where sums along rows and a derived gradient make it 1.28 (docs/lab_notes.md).


@jax.custom_vjp
def _standardized(x: jax.Array) -> jax.Array:
    return _standardized_forward(x)[0]


def _standardized_forward(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    centred = x - _row_mean(x)
    scale = jax.lax.rsqrt(_row_mean(centred * centred) + 1e-6)
    return centred * scale, (centred * scale, scale)


def _standardized_backward(kept: tuple[jax.Array, jax.Array], gradient: jax.Array) -> tuple[jax.Array]:
    """Without the parts of the gradient along a shift and a scaling of the row, neither of which changes the output."""
    y, scale = kept
    return (scale * (gradient - _row_mean(gradient) - y * _row_mean(gradient * y)),)


_standardized.defvjp(_standardized_forward, _standardized_backward)


def _row_mean(x: jax.Array) -> jax.Array:
    """[..., H] -> [..., 1]."""
    ones = jnp.ones((x.shape[-1], 1), x.dtype)
    return jnp.matmul(x, ones, precision=jax.lax.Precision.HIGHEST) / x.shape[-1]


NORMS: dict[str, Callable[[jax.Array], jax.Array]] = {"none": lambda x: x, "layer": layer_norm}


class ReluMLP(nn.Module):
    """Dense layers with ReLU between them, and a linear output.

    Attributes:
        norm: of what goes into each ReLU, a name in `NORMS`.
        precision: a name in `PRECISIONS`.
    """

    output_size: int
    hidden_size: int
    hidden_layers: int
    norm: str = "none"
    precision: str = "default"

    @nn.compact
    def __call__(self, hidden: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        for index in range(self.hidden_layers):
            hidden = hidden_layer(index, hidden, self.hidden_size, policy_init, self.precision)
            hidden = nn.relu(NORMS[self.norm](hidden))
        return layer(self.output_size, policy_init, self.precision)(hidden)


class TanhGaussian(NamedTuple):
    """The distribution of tanh(u), u ~ Normal(loc, scale²), independently per action.

    Attributes:
        loc, scale: [..., A].
    """

    loc: jax.Array
    scale: jax.Array

    def sample(self, key: PRNGKeyArray) -> tuple[Float[Array, "*batch A"], Float[Array, "*batch"]]:
        """An action and its log-density."""
        return self.reparameterized(jax.random.normal(key, self.loc.shape))

    def reparameterized(
        self, noise: Float[Array, "*batch A"]
    ) -> tuple[Float[Array, "*batch A"], Float[Array, "*batch"]]:
        """The action that standard normal noise becomes, and its log-density."""
        pre_tanh = self.loc + self.scale * noise
        log_normal = -0.5 * noise**2 - jnp.log(self.scale) - 0.5 * jnp.log(2 * jnp.pi)
        # log(1 - tanh²u) = 2 (log 2 - u - softplus(-2u)): no cancellation where tanh saturates.
        log_slope = 2 * (jnp.log(2.0) - pre_tanh - jax.nn.softplus(-2 * pre_tanh))
        return jnp.tanh(pre_tanh), jnp.sum(log_normal - log_slope, axis=-1)

    def mode(self) -> Float[Array, "*batch A"]:
        """tanh(loc): the action taken in evaluation."""
        return jnp.tanh(self.loc)


class Actor(nn.Module):
    """π(a | s), tanh-Gaussian.

    Attributes:
        precision: a name in `PRECISIONS`.
    """

    action_size: int
    hidden_size: int
    hidden_layers: int
    precision: str = "default"

    @nn.compact
    def __call__(self, obs: Float[Array, "*batch O"]) -> TanhGaussian:
        """The distribution of actions."""
        mlp = ReluMLP(2 * self.action_size, self.hidden_size, self.hidden_layers, precision=self.precision)
        outputs = mlp(obs)
        loc, raw_scale = jnp.split(outputs, 2, axis=-1)
        return TanhGaussian(loc, nn.softplus(raw_scale) + MIN_SCALE)

    def distribution(self, params: Params, obs: Float[Array, "*batch O"]) -> TanhGaussian:
        """π(· | obs) of these parameters."""
        distribution: Any = self.apply(params, obs)
        return distribution


class TwinCritic(nn.Module):
    """Two independent Q(s, a); `norm` and `precision` as in `ReluMLP`."""

    hidden_size: int
    hidden_layers: int
    norm: str = "none"
    precision: str = "default"

    @nn.compact
    def __call__(
        self, obs: Float[Array, "*batch O"], action: Float[Array, "*batch A"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        """Q_1 and Q_2."""
        inputs = jnp.concatenate([obs, action], axis=-1)
        critic = partial(ReluMLP, 1, self.hidden_size, self.hidden_layers, self.norm, self.precision)
        return critic(name="first")(inputs)[..., 0], critic(name="second")(inputs)[..., 0]

    def values(
        self, params: Params, obs: Float[Array, "*batch O"], action: Float[Array, "*batch A"]
    ) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        """Q_1 and Q_2 of these parameters."""
        values: Any = self.apply(params, obs, action)
        return values
