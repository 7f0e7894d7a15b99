"""The choice among a state's candidates."""

from __future__ import annotations

import numpy as np

from quad_rl.onnx.graph import END, Value


def sample_index(scores: Value, temperature: float, uniform: Value) -> Value:
    """Samples an index [n, 1] into scores [n, candidates], with probability softmax(scores / temperature), by `uniform` [n, 1].

    In float64, as the policy samples: small weights are lost in a float32 sum. For uniform = 1 it is the best.
    """
    graph = scores.graph
    shifted = (scores - graph("ReduceMax", scores, axes=[1], keepdims=1)).double()
    sums = graph("CumSum", graph("Exp", shifted / graph.double(temperature)), np.array(1))
    beyond = graph("Cast", graph("Greater", sums, uniform.double() * sums.slice(1, -1, END)), to=1)
    some = graph("Cast", graph("ReduceMax", beyond, axes=[1], keepdims=1), to=9)
    return graph("Where", some, graph("ArgMax", beyond, axis=1), graph("ArgMax", scores, axis=1))


def choose(drawn: Value, scores: Value, rule: str, candidates: int, uniform: Value | None) -> Value:
    """The rule's choice [n, width] among drawn [n, candidates, width], by scores [n, candidates]."""
    graph = drawn.graph
    name, *numbers = rule.split(":")
    if candidates == 1:
        return drawn.at(1, 0)
    if uniform is None:
        return graph("GatherND", drawn, graph("ArgMax", scores, axis=1), batch_dims=1)
    temperature = float(numbers[0])
    if name == "softmax":
        return graph("GatherND", drawn, sample_index(scores, temperature, uniform), batch_dims=1)
    # Samples without replacement. Scores are capped at 40 temperatures above the smallest of the `count` largest.
    count = min(int(numbers[1]), candidates)
    largest = graph("TopK", scores, np.array([count]), axis=1).slice(1, count - 1, count)
    scores = graph("Min", scores, largest + np.float32(40) * np.float32(temperature))
    gone = -np.inf
    taken = None
    for i in range(count):
        index = sample_index(scores, temperature, uniform.slice(1, i, i + 1))
        hit = graph("Equal", np.arange(candidates), index)
        scores = graph("Where", hit, gone, scores)
        taken = hit if taken is None else graph("Or", taken, hit)
    share = graph("Cast", taken, to=1) / float(count)
    return (share.reshape(-1, 1, candidates) @ drawn).at(1, 0)
