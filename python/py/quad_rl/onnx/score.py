"""Samples of SfBC's policy: a score network, solved backwards in time by DPM-Solver-fast, unrolled."""

import math

import numpy as np

from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import activate


class Network:
    """ε_θ(a_t, s, t) of actions [n, candidates, a] in states [n, o]."""

    def __init__(self, file: File, observations: Value) -> None:
        self.file, self.config = file, file.shape["actor"]
        self.state = self.active("state", observations)

    def linear(self, name: str, x: Value) -> Value:
        return x @ self.file[f"actor.{name}.kernel"] + self.file[f"actor.{name}.bias"]

    def active(self, name: str, x: Value) -> Value:
        return activate(self.config["activation"], self.linear(name, x))

    def block(self, name: str, x: Value, condition: Value) -> Value:
        inner = self.active(f"{name}.first", x) + self.linear(f"{name}.condition", condition)
        skip = self.linear(f"{name}.skip", x) if f"actor.{name}.skip.kernel" in self.file else x
        return self.active(f"{name}.second", inner) + skip

    def __call__(self, x: Value, t: float) -> Value:
        file, angles = self.file, 2 * math.pi * t * self.file["frequencies"].astype(np.float64)
        time = np.concatenate([np.sin(angles), np.cos(angles)]) @ file["actor.time.kernel"] + file["actor.time.bias"]
        kernel, bias = file["actor.mix.0.kernel"], file["actor.mix.0.bias"]
        mixed = self.state @ kernel[:32] + (time @ kernel[32:] + bias)
        condition = self.active("mix.1", activate(self.config["activation"], mixed))
        condition = x.graph("Unsqueeze", condition, np.array([1]))
        widths, narrowed = self.config["hidden"], []
        for i in range(len(widths)):
            x = self.block(f"down.{i}", x, condition)
            narrowed.append(x)
        x = self.block("middle", x, condition)
        for i in range(len(widths) - 1):
            x = self.block(f"up.{i}", x.graph("Concat", narrowed.pop(), x, axis=2), condition)
        return self.linear("last", x.graph("Concat", narrowed.pop(), x, axis=2))


class Time:
    """The noise of time t: a_t = signal·a + deviation·ε; `ratio` is the log of their quotient."""

    def __init__(self, t: float) -> None:
        log_signal = -0.25 * t * t * 19.9 - 0.5 * t * 0.1
        self.t, self.signal, self.deviation = t, math.exp(log_signal), math.sqrt(-math.expm1(2 * log_signal))
        self.ratio = log_signal - math.log(self.deviation)


def step(times: list[Time], x: Value, noise: Network) -> Value:
    """One step from the first to the last of the times; its order is their number less one."""
    start, end, epsilon = times[0], times[-1], noise(x, times[0].t)

    def straight(to: Time) -> Value:
        return x * (to.signal / start.signal) - epsilon * (to.deviation * math.expm1(to.ratio - start.ratio))

    def curvature(h: float) -> float:
        return math.expm1(h) / h - 1

    h = [time.ratio - start.ratio for time in times]
    if len(times) == 2:
        return straight(end)
    change = noise(straight(times[1]), times[1].t) - epsilon
    if len(times) == 3:
        return straight(end) - change * (end.deviation * math.expm1(h[2]) * 0.5 * h[2] / h[1])
    bent = straight(times[2]) - change * (h[2] / h[1] * times[2].deviation * curvature(h[2]))
    change = noise(bent, times[2].t) - epsilon
    return straight(end) - change * (h[3] / h[2] * end.deviation * curvature(h[3]))


def draw(file: File, observations: Value, noise: Value, candidates: int) -> Value:
    count, network, x, first = file.shape["evaluations"], Network(file, observations), noise.at(1, 0), 0
    times = [Time(1 - 0.999 * i / count) for i in range(count + 1)]
    third, last = {0: (count // 3 - 1, [2, 1]), 1: (count // 3, [1]), 2: (count // 3, [2])}[count % 3]
    for order in [3] * third + last:
        x = step(times[first : first + order + 1], x, network)
        first += order
    return x
