"""Multi-layer perceptrons and ensembles of them."""

from __future__ import annotations

from typing import Any

import numpy as np

from quad_rl.onnx.file import Array, File
from quad_rl.onnx.graph import Value

_TWICE = 2 * np.sqrt(2 / np.pi)


def activate(name: str, x: Value) -> Value:
    if name == "mish":
        # x·tanh(softplus(x)) with one exponential; from 20 on it is x. Opset 17 has no Mish.
        e = x.graph("Exp", x.graph("Min", x, 20.0))
        n = e * (e + 2.0)
        return x * (n / (n + 2.0))
    if name == "gelu":
        # The tanh form of x·Φ(x), as x·σ(2u).
        return x * x.graph("Sigmoid", x * (x * x * (0.044715 * _TWICE) + _TWICE))
    return x * x.graph("Sigmoid", x) if name == "silu" else x.graph({"relu": "Relu", "tanh": "Tanh"}[name], x)


def mish(x: Array) -> Array:
    """Mish of an array."""
    return x * np.tanh(np.logaddexp(x, 0))


def layer_norm(x: Value, scale: Array, shift: Array, epsilon: float, axis: int = -1) -> Value:
    centered = x - x.mean(axis)
    deviation = x.graph("Sqrt", (centered * centered).mean(axis) + epsilon)
    return centered / deviation * scale + shift


def layers(file: File, prefix: str, config: dict[str, Any], x: Value) -> Value:
    """Applies all layers to the first layer's pre-activations: x [..., width], or [K, rows, width] of an ensemble."""
    for i in range(len(config["hidden"])):

        def tensor(layer: int, kind: str) -> Array:
            array = file[f"{prefix}{layer}.{kind}"]
            return array if array.ndim == 1 or kind == "kernel" else array[:, None]

        def normed(x: Value, after: bool) -> Value:
            if not config["norm"] or config.get("norm_after", False) != after:
                return x
            epsilon = 1e-5 if config.get("norm_epsilon") == "torch" else 1e-6
            return layer_norm(x, tensor(i, "scale"), tensor(i, "shift"), epsilon)

        x = normed(activate(config["activation"], normed(x, False)), True) @ tensor(i + 1, "kernel") + tensor(i + 1, "bias")
    return x


def of_states(file: File, prefix: str, config: dict[str, Any], observations: Value) -> Value:
    """An ensemble's outputs [K, n, outputs] for observations [n, o]."""
    first = observations @ file[f"{prefix}0.kernel"] + file[f"{prefix}0.bias"][:, None]
    return layers(file, prefix, config, first)


def of_actions(
    file: File, prefix: str, config: dict[str, Any], observations: Value, actions: Value, each: int, outputs: int = 1
) -> Value:
    """An ensemble's outputs [K, n, each] or [K, n, each, outputs] for observations [n, o] and actions [n, each, a]."""
    kernel, bias = file[f"{prefix}0.kernel"], file[f"{prefix}0.bias"]
    (members, _, width), a = kernel.shape, file.shape["action_dim"]
    state = (observations @ kernel[:, :-a] + bias[:, None]).reshape(members, -1, 1, width)
    action = (actions.reshape(-1, a) @ kernel[:, -a:]).reshape(members, -1, each, width)
    out = layers(file, prefix, config, (state + action).reshape(members, -1, width))
    return out.reshape(members, -1, each, *([outputs] if outputs > 1 else []))
