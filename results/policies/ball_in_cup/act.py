"""A policy that vecpsmbpo has trained, in NumPy alone: obs [..., O] -> action [..., A] in [-1, 1]."""

from pathlib import Path

import numpy as np

WEIGHTS = np.load(Path(__file__).with_name("policy.npz"))
LAYERS = [(WEIGHTS[f"kernel_{i}"], WEIGHTS[f"bias_{i}"]) for i in range(len(WEIGHTS) // 2)]


def act(obs):
    hidden = np.asarray(obs, np.float32)
    for kernel, bias in LAYERS[:-1]:
        hidden = np.maximum(hidden @ kernel + bias, 0)
    kernel, bias = LAYERS[-1]
    return np.tanh(hidden @ kernel + bias)


if __name__ == "__main__":
    print(act(np.zeros(LAYERS[0][0].shape[0])))
