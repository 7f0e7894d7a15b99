"""Multi-layer perceptrons and ensembles of them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
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


def slope(name: str, x: Value) -> Value:
    """The derivative of `activate`."""
    if name == "mish":
        e = x.graph("Exp", x.graph("Min", x, 20.0))
        n = e * (e + 2.0)
        return (n + x * (e * (e + 1.0) * 4.0) / (n + 2.0)) / (n + 2.0)
    if name == "relu":
        return x.graph("Cast", x.graph("Greater", x, 0.0), to=1)
    if name == "tanh":
        y = x.graph("Tanh", x)
        return 1.0 - y * y
    cubic = 0.044715 * _TWICE if name == "gelu" else 0.0
    linear = _TWICE if name == "gelu" else 1.0
    s = x.graph("Sigmoid", x * (x * x * cubic + linear))
    return s + x * s * (1.0 - s) * (x * x * (3 * cubic) + linear)


def mish(x: Array) -> Array:
    """Mish of an array."""
    return x * np.tanh(np.logaddexp(x, 0))


def layer_norm(x: Value, scale: Array, shift: Array, epsilon: float, axis: int = -1) -> Value:
    centered = x - x.mean(axis)
    deviation = x.graph("Sqrt", (centered * centered).mean(axis) + epsilon)
    return centered / deviation * scale + shift


def layer_norm_gradient(x: Value, scale: Array, epsilon: float, gradient: Value) -> Value:
    """The gradient with respect to `layer_norm`'s x, given that of its output."""
    centered, gradient = x - x.mean(-1), gradient * scale
    deviation = x.graph("Sqrt", (centered * centered).mean(-1) + epsilon)
    normal = centered / deviation
    return (gradient - gradient.mean(-1) - normal * (gradient * normal).mean(-1)) / deviation


def activation_gradient(name: str, x: Value, gradient: Value) -> Value:
    return gradient * slope(name, x)


def product_gradient(kernel: Array, gradient: Value) -> Value:
    """The gradient with respect to x of x @ kernel [K, in, out]."""
    return gradient @ gradient.graph.constant(kernel).transpose(0, 2, 1)


def layers(
    file: File, prefix: str, config: dict[str, Any], x: Value, backward: list[Callable[[Value], Value]] | None = None
) -> Value:
    """Applies all layers to the first layer's pre-activations: x [..., width], or [K, rows, width] of an ensemble. Each step's
    map from its output's gradient to its input's is added to `backward`.
    """
    backward = [] if backward is None else backward
    for i in range(len(config["hidden"])):

        def tensor(layer: int, kind: str) -> Array:
            array = file[f"{prefix}{layer}.{kind}"]
            return array if array.ndim == 1 or kind == "kernel" else array[:, None]

        def normed(x: Value, after: bool) -> Value:
            if not config["norm"] or config.get("norm_after", False) != after:
                return x
            epsilon = 1e-5 if config.get("norm_epsilon") == "torch" else 1e-6
            scale = tensor(i, "scale")
            backward.append(partial(layer_norm_gradient, x, scale, epsilon))
            return layer_norm(x, scale, tensor(i, "shift"), epsilon)

        before, kernel = normed(x, False), tensor(i + 1, "kernel")
        backward.append(partial(activation_gradient, config["activation"], before))
        x = normed(activate(config["activation"], before), True) @ kernel + tensor(i + 1, "bias")
        backward.append(partial(product_gradient, kernel))
    return x


def state_outputs(file: File, prefix: str, config: dict[str, Any], observations: Value) -> Value:
    """An ensemble's outputs [K, n, outputs] for observations [n, o]."""
    first = observations @ file[f"{prefix}0.kernel"] + file[f"{prefix}0.bias"][:, None]
    return layers(file, prefix, config, first)


def action_outputs(
    file: File, prefix: str, config: dict[str, Any], observations: Value, actions: Value, each: int, outputs: int = 1
) -> Value:
    """An ensemble's outputs [K, n, each] or [K, n, each, outputs] for observations [n, o] and actions [n, each, a]."""
    out = layers(file, prefix, config, first(file, prefix, observations, actions, each))
    return out.reshape(len(file[f"{prefix}0.kernel"]), -1, each, *([outputs] if outputs > 1 else []))


def first(file: File, prefix: str, observations: Value, actions: Value, each: int) -> Value:
    """The first layer's pre-activations [K, n·each, width]."""
    kernel, bias = file[f"{prefix}0.kernel"], file[f"{prefix}0.bias"]
    (members, _, width), a = kernel.shape, file.shape["action_dim"]
    state = (observations @ kernel[:, :-a] + bias[:, None]).reshape(members, -1, 1, width)
    action = (actions.reshape(-1, a) @ kernel[:, -a:]).reshape(members, -1, each, width)
    return (state + action).reshape(members, -1, width)


def action_gradient(
    file: File, prefix: str, config: dict[str, Any], observations: Value, actions: Value, each: int
) -> Value:
    """The gradient of the mean output of an ensemble with respect to actions, both [n, each, a], by a backward pass."""
    backward: list[Callable[[Value], Value]] = []
    layers(file, prefix, config, first(file, prefix, observations, actions, each), backward)
    kernel, a = file[f"{prefix}0.kernel"], file.shape["action_dim"]
    gradient = actions.graph.constant(np.ones((1, 1, 1)))
    for step in reversed(backward):
        gradient = step(gradient)
    return product_gradient(kernel[:, -a:], gradient).mean(0).reshape(-1, each, a)
