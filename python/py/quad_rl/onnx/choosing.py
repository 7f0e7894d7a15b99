"""Which of a state's candidates is taken, or the mean of which."""

from __future__ import annotations

import numpy as np

from quad_rl.onnx.graph import END, Value


def drawn_place(worth: Value, temperature: float, uniform: Value) -> Value:
    """A place [n, 1] of worth [n, candidates], with a probability proportional to exp(worth / temperature).

    In float64, as the policy draws: a float32 sum of many weights does not see the small ones, and takes them at either end.
    Where nothing is beyond the number, as at 1, it is the best.
    """
    graph = worth.graph
    away = (worth - graph("ReduceMax", worth, axes=[1], keepdims=1)).double()
    sums = graph("CumSum", graph("Exp", away / graph.double(temperature)), np.array(1))
    beyond = graph("Cast", graph("Greater", sums, uniform.double() * sums.part(1, -1, END)), to=1)
    some = graph("Cast", graph("ReduceMax", beyond, axes=[1], keepdims=1), to=9)
    return graph("Where", some, graph("ArgMax", beyond, axis=1), graph("ArgMax", worth, axis=1))


def choose(drawn: Value, worth: Value, rule: str, candidates: int, uniform: Value | None) -> Value:
    """Of what was drawn, [n, candidates, width], the rule's choice [n, width]; worth [n, candidates] is what it compares."""
    graph = drawn.graph
    name, *numbers = rule.split(":")
    if candidates == 1:
        return drawn.at(1, 0)
    if uniform is None:
        return graph("GatherND", drawn, graph("ArgMax", worth, axis=1), batch_dims=1)
    temperature = float(numbers[0])
    if name == "softmax":
        return graph("GatherND", drawn, drawn_place(worth, temperature, uniform), batch_dims=1)
    # Several, each once. Worth counts up to 40 temperatures above the smallest of as many largest.
    count = min(int(numbers[1]), candidates)
    largest = graph("TopK", worth, np.array([count]), axis=1).part(1, count - 1, count)
    worth = graph("Min", worth, largest + np.float32(40) * np.float32(temperature))
    gone = -np.inf
    taken = None
    for i in range(count):
        here = drawn_place(worth, temperature, uniform.part(1, i, i + 1))
        hit = graph("Equal", np.arange(candidates), here)
        worth = graph("Where", hit, gone, worth)
        taken = hit if taken is None else graph("Or", taken, hit)
    share = graph("Cast", taken, to=1) / float(count)
    return (share.reshape(-1, 1, candidates) @ drawn).at(1, 0)
