"""A policy as matrices: what is left of it without JAX and flax."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

Array = np.ndarray
Layer = tuple[Array, Array]  # kernel [in, out], bias [out]


class Rule(NamedTuple):
    """A function of each number by itself.

    Attributes:
        apply: (array, its array module) -> array.
        code: the same in NumPy, of what is put between the braces.
        onnx: the operation's name in ONNX.
    """

    apply: Callable[[Any, Any], Any]
    code: str
    onnx: str


RULES = {
    "relu": Rule(lambda x, xp: xp.maximum(x, 0), "np.maximum({}, 0)", "Relu"),
    "tanh": Rule(lambda x, xp: xp.tanh(x), "np.tanh({})", "Tanh"),
    "clip": Rule(lambda x, xp: xp.clip(x, -1, 1), "np.clip({}, -1, 1)", "Clip"),
}


@dataclass(frozen=True)
class Feedforward:
    """obs [..., O] -> mean action [..., A] in [-1, 1].

    Attributes:
        layers: in order.
        hidden, end: of `RULES`, what follows every layer but the last, and the last.
    """

    layers: tuple[Layer, ...]
    hidden: str = "relu"
    end: str = "tanh"

    def __call__(self, obs: Any, xp: Any = np) -> Any:
        """The action, in float32.

        Args:
            xp: the array module to compute with.
        """
        x = xp.asarray(obs, xp.float32)
        for kernel, bias in self.layers[:-1]:
            x = RULES[self.hidden].apply(x @ kernel + bias, xp)
        kernel, bias = self.layers[-1]
        return RULES[self.end].apply(x @ kernel + bias, xp)

    @property
    def obs_size(self) -> int:
        return len(self.layers[0][0])

    @property
    def action_size(self) -> int:
        return len(self.layers[-1][1])

    @property
    def arrays(self) -> dict[str, Array]:
        """The layers by name."""
        named = ((f"kernel_{i}", kernel, f"bias_{i}", bias) for i, (kernel, bias) in enumerate(self.layers))
        return {name: array for k, kernel, b, bias in named for name, array in ((k, kernel), (b, bias))}


def layers_of(arrays: Mapping[str, Array]) -> tuple[Layer, ...]:
    """From names as `Feedforward.arrays` has them."""
    return tuple((arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(len(arrays) // 2))


def dense_layers(params: Mapping[str, Mapping[str, Any]]) -> tuple[Layer, ...]:
    """Of flax's parameters of some dense layers, `Dense_0`, `Dense_1`, …"""
    ordered = (params[f"Dense_{i}"] for i in range(len(params)))
    return tuple((np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in ordered)


def first_outputs(layers: tuple[Layer, ...], count: int) -> tuple[Layer, ...]:
    """The same network without the outputs from `count` on."""
    kernel, bias = layers[-1]
    return (*layers[:-1], (kernel[:, :count], bias[:count]))


def on_raw(layers: tuple[Layer, ...], mean: Any, std: Any) -> tuple[Layer, ...]:
    """The same network, of inputs that have not been whitened with mean and std, [in] each."""
    kernel, bias = (array.astype(np.float64) for array in layers[0])
    raw = kernel / np.asarray(std, np.float64)[:, None]
    first = raw.astype(np.float32), (bias - np.asarray(mean, np.float64) @ raw).astype(np.float32)
    return (first, *layers[1:])
