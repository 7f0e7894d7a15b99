"""Layers of networks over windows [B, channels, steps], and gradients for guidance."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from quad_rl.onnx.file import Array, File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import activate, layer_norm, mish

# Maps the gradient of a layer's output to that of its input.
Back = Callable[[Value], Value]


def mish_slope(x: Value) -> Value:
    e = x.graph("Exp", x.graph("Min", x, 20.0))
    n = e * (e + 2.0)
    below = n + 2.0
    return n / below + x * (e * (e + 1.0) / (below * below) * 4.0)


class Layers:
    """The layers of a network whose tensors begin with `prefix`, at the denoising steps of `times`."""

    def __init__(self, file: File, prefix: str, times: list[int]) -> None:
        self.file, self.prefix, self.config = file, prefix, file.shape["network"]
        half = self.config["channels"] // 2
        angles = (np.array(times)[:, None] - 1) * np.exp(-np.arange(half) * math.log(10_000) / (half - 1))
        x = np.concatenate([np.sin(angles), np.cos(angles)], 1)
        (first, first_bias), (second, second_bias) = (self.tensors(f"time.{i}") for i in range(2))
        # [times, channels]
        self.embedding = mish(x @ first + first_bias) @ second + second_bias

    def tensors(self, name: str, kinds: tuple[str, ...] = ("kernel", "bias")) -> list[Array]:
        return [self.file[f"{self.prefix}{name}.{kind}"] for kind in kinds]

    def convolution(self, name: str, x: Value, length: int, stride: int = 1) -> tuple[Value, Back]:
        """A convolution over windows of that length; a linear layer has a kernel of one step."""
        kernel, bias = self.tensors(name)
        kernel = (kernel if kernel.ndim == 3 else kernel[None]).transpose(2, 1, 0)
        around = {"pads": [kernel.shape[2] // 2] * 2, "strides": [stride]}
        left = [(length - 1) % stride]
        return x.graph("Conv", x, kernel, bias, **around), lambda g: g.graph(
            "ConvTranspose", g, kernel, output_padding=left, **around)

    def normed(self, name: str, x: Value, length: int) -> tuple[Value, Back]:
        """A convolution, group norm, Mish."""
        x, back = self.convolution(name, x, length)
        scale, shift = (array[:, None] for array in self.tensors(name, ("scale", "shift")))
        channels, grouped = len(scale), (0, self.config["groups"], -1)
        x = x.reshape(*grouped)
        centered = x - x.mean(2)
        deviation = x.graph("Sqrt", (centered * centered).mean(2) + 1e-5)
        normed = centered / deviation
        linear = normed.reshape(0, channels, length) * scale + shift

        def gradient(g: Value) -> Value:
            g = (g * mish_slope(linear) * scale).reshape(*grouped)
            return back(((g - g.mean(2) - normed * (g * normed).mean(2)) / deviation).reshape(0, channels, length))

        return activate("mish", linear), gradient

    def block(self, name: str, x: Value, length: int, t: Value) -> tuple[Value, Back]:
        """A residual block, at the t-th of the times."""
        kernel, bias = self.tensors(f"{name}.time")
        times = (mish(self.embedding) @ kernel + bias)[..., None]
        inner, first = self.normed(f"{name}.0", x, length)
        inner, second = self.normed(f"{name}.1", inner + x.graph.constant(times).at(0, t), length)
        if f"{self.prefix}{name}.skip.kernel" not in self.file:
            return inner + x, lambda g: first(second(g)) + g
        beside, skip = self.convolution(f"{name}.skip", x, length)
        return inner + beside, lambda g: first(second(g)) + skip(g)

    def double(self, name: str, x: Value) -> Value:
        kernel, bias = self.tensors(name)
        return x.graph("ConvTranspose", x, kernel.transpose(0, 2, 1), bias, pads=[1, 1], strides=[2])

    def attend(self, name: str, x: Value, length: int) -> Value:
        """x plus linear attention of its layer norm, if the network has attention."""
        graph, attention = x.graph, self.config.get("attention")
        if not attention:
            return x
        scale, shift = (array[:, None] for array in self.tensors(name, ("scale", "shift")))
        (kernel,) = self.tensors(f"{name}.queries", ("kernel",))
        heads, width = attention["heads"], attention["width"]
        all = kernel.T @ layer_norm(x, scale, shift, 1e-5, axis=1)
        queries, keys, values = (all.reshape(0, 3, heads, width, length).at(1, i) for i in range(3))
        gathered = values @ graph("Softmax", keys, axis=-1).transpose(0, 1, 3, 2)
        read = (gathered @ queries * width**-0.5).reshape(0, heads * width, length)
        return x + self.convolution(f"{name}.out", read, length)[0]

    def lengths(self) -> list[int]:
        return [self.config["horizon"] >> level for level in range(len(self.config["multipliers"]))]


class Model(Layers):
    """A U-Net that predicts the clean windows from noisy ones at the t-th of the times."""

    def __call__(self, x: Value, t: Value) -> Value:
        lengths, beside = self.lengths(), []
        for level, length in enumerate(lengths):
            for i in range(2):
                x, _ = self.block(f"down.{level}.{i}", x, length, t)
            x = self.attend(f"down.{level}.attention", x, length)
            beside.append(x)
            if level + 1 < len(lengths):
                x, _ = self.convolution(f"down.{level}.halve", x, length, stride=2)
        x, _ = self.block("middle.0", x, lengths[-1], t)
        x = self.attend("middle.attention", x, lengths[-1])
        x, _ = self.block("middle.1", x, lengths[-1], t)
        for level, length in enumerate(lengths[:0:-1]):
            x = x.graph("Concat", x, beside.pop(), axis=1)
            for i in range(2):
                x, _ = self.block(f"up.{level}.{i}", x, length, t)
            x = self.double(f"up.{level}.double", self.attend(f"up.{level}.attention", x, length))
        return self.convolution("out", self.normed("last", x, lengths[0])[0], lengths[0])[0]


class ValueFunction(Layers):
    """Predicts the returns [B, 1] of noisy windows at the t-th of the times, with their gradient."""

    def __call__(self, x: Value, t: Value) -> tuple[Value, Callable[[], Value]]:
        backs: list[Back] = []

        def keep(made: tuple[Value, Back]) -> Value:
            backs.append(made[1])
            return made[0]

        lengths = self.lengths()
        lengths += [(lengths[-1] + 1) // 2, (lengths[-1] + 3) // 4]
        names = [f"level.{i}" for i in range(len(lengths) - 2)] + ["middle.0", "middle.1"]
        for name, length in zip(names, lengths):
            for i in range(2 if name.startswith("level") else 1):
                x = keep(self.block(f"{name}.{i}", x, length, t))
            x = keep(self.convolution(f"{name}.halve", x, length, stride=2))
        length, channels = (lengths[-1] + 1) // 2, self.file[f"{self.prefix}middle.1.halve.bias"].shape[0]
        (kernel, bias), (last, last_bias) = (self.tensors(f"head.{i}") for i in range(2))
        flat, width = length * channels, kernel.shape[1]
        # Rows: [steps · channels], then the embedding.
        rows = kernel[:flat].reshape(length, channels, width).transpose(1, 0, 2).reshape(flat, width)
        times = x.graph.constant(self.embedding @ kernel[flat:] + bias).at(0, t)
        linear = x.reshape(-1, flat) @ rows + times

        def gradient() -> Value:
            g = ((mish_slope(linear) * last[:, 0]) @ rows.T).reshape(-1, channels, length)
            for back in reversed(backs):
                g = back(g)
            return g

        return activate("mish", linear) @ last + last_bias, gradient
