"""Diffuser's planner: windows [a + o, steps] of actions and states, denoised from their first state on and pulled along the
gradient of their value. Denoising steps of one kind are a loop of the graph."""

from __future__ import annotations

import numpy as np

from quad_rl.onnx.diffusion import cosine
from quad_rl.onnx.file import Array, File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.window import Model, ValueFunction


def schedule(steps: int) -> tuple[Array, Array, Array]:
    """For t = 0..T: factors of the clean and of the noisy window, and the noise's variance."""
    alpha = np.concatenate([[1.0], cosine(steps)])
    bar = np.cumprod(alpha)
    before, left = np.concatenate([[1.0], bar[:-1]]), np.maximum(1 - bar, 1e-300)
    from_clean, from_noisy = np.sqrt(before) * (1 - alpha) / left, np.sqrt(alpha) * (1 - before) / left
    return from_clean, from_noisy, (1 - alpha) * (1 - before) / left


def plan(file: File, observations: Value, noise: Value, plans: int) -> tuple[Value, Value]:
    """The first actions of each plan [n, plans, steps · a], and the plans' values [n, plans]."""
    graph, guidance, horizon = noise.graph, file.shape["guidance"], file.shape["network"]["horizon"]
    o, a, steps, taken = (file.shape[name] for name in ("observation_dim", "action_dim", "diffusion_steps", "replan_every"))
    width = o + a
    # x·mask + first sets the first state of a window.
    place = np.zeros((o, width, horizon))
    place[np.arange(o), np.arange(a, width), 0] = 1
    first = (observations @ place.reshape(o, -1)).reshape(-1, 1, width, horizon)
    first = graph("Tile", first, np.array([1, plans, 1, 1])).reshape(-1, width, horizon)
    mask: Array = 1 - place.sum(0)
    from_clean, from_noisy, variance = schedule(steps)

    def drawn(index: Value) -> Value:
        return noise.at(1, index).reshape(-1, horizon, width).transpose(0, 2, 1)

    def denoise(x: Value, times: list[int], guided: bool) -> Value:
        """Denoises at each t of `times`, all above 1."""
        model, value = Model(file, "model.", times), ValueFunction(file, "value.", times)

        def body(i: Value, x: Value) -> Value:
            def at_step(numbers: Array) -> Value:
                return graph.constant(numbers[times]).at(0, i)

            for _ in range(guidance["steps"] if guided else 0):
                x = (x + value(x, i)[1]() * at_step(guidance["scale"] * variance)) * mask + first
            z = drawn(i + np.array(steps - times[0] + 1)) * at_step(np.sqrt(variance))
            return (model(x, i) * at_step(from_clean) + x * at_step(from_noisy) + z) * mask + first

        return graph.repeat(len(times), x, body) if times else x

    x = drawn(graph.constant(np.array(0))) * mask + first
    stop = max(guidance["stop"], 1)
    x = denoise(x, list(range(steps, stop, -1)), guided=True)
    x = denoise(x, list(range(min(stop, steps), 1, -1)), guided=False)
    last = graph.constant(np.array(0))
    value, _ = ValueFunction(file, "value.", [1])(x, last)
    x = Model(file, "model.", [1])(x, last) * float(from_clean[1]) + x * float(from_noisy[1])
    actions = x.slice(1, 0, a).slice(2, 0, taken).transpose(0, 2, 1)
    return actions.reshape(-1, plans, taken * a), value.reshape(-1, plans)
