"""The model of a policy: units, samples, critics, and the choice."""

from __future__ import annotations

from typing import Any

import numpy as np
from onnx import ModelProto

from quad_rl._quad_rl import Policy
from quad_rl.onnx import diffusion, flow, gaussian, one_step, planner, score, squashed
from quad_rl.onnx.choosing import choose
from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Graph, Value
from quad_rl.onnx.mlp import action_outputs, state_outputs

DRAW = {"diffusion": diffusion.draw, "flow": flow.draw, "one-step": one_step.draw, "score": score.draw, "squashed": squashed.draw}


def to_network(file: File, observations: Value) -> Value:
    for maps in file.units:
        if units := maps.get("observations"):
            scale = np.array(units["scale"])
            # A constant observation has scale 0; the network gets 0.
            observations = (observations - units["offset"]) / np.where(scale == 0, np.inf, scale)
    return observations


def to_user(file: File, actions: Value) -> Value:
    for maps in reversed(file.units):
        if units := maps.get("actions"):
            actions = actions * units["scale"] + units["offset"]
    return actions


def critics(file: File, choice: dict[str, Any], observations: Value, drawn: Value) -> tuple[Value, Value]:
    """The critics' values of drawn [n, candidates, a], and the rule's scores; both [n, candidates]."""
    graph, candidates = drawn.graph, choice["candidates"]
    members = action_outputs(file, "critic.", file.shape["critic"], observations, drawn, candidates)
    values = graph("ReduceMin" if choice["aggregate"] == "min" else "ReduceMean", members, axes=[0], keepdims=0)
    if choice["aggregate"].startswith("mean-minus-std:"):
        away = members - values
        values = values - graph("Sqrt", (away * away).mean(0)).at(0, 0) * float(choice["aggregate"].split(":")[1])
    if choice["rule"] != "nearest":
        return values, values
    difference = values - state_outputs(file, "value.", file.shape["value"], observations).reshape(-1, 1)
    return values, 0.0 - difference * difference


def model(policy: Policy, **changes: Any) -> ModelProto:
    # The noise for one state; refuses choices that `act` refuses.
    drawn = policy.noise(1, **changes, seed=0)
    single = {"candidates": 1, "rule": "best", "guidance": 0.0}  # Of a policy without critics.
    choice = {**(policy.choice or single), **{name: change for name, change in changes.items() if change is not None}}
    file, graph, a = File(policy.to_bytes()), Graph(), policy.action_size
    chunk, o = file.chunk or {}, policy.observation_size
    seen = chunk.get("history", 1)
    observations = to_network(file, graph.input("observations", (seen, o) if seen > 1 else (o,))).reshape(-1, seen * o)
    inputs = {name: graph.input(name, array.shape[1:]) for name, array in drawn.items()}
    if file.kind == "gaussian":
        return graph.model({"actions": (to_user(file, gaussian.mode(file, observations)), (a,))}, repr(policy))
    candidates, rule = choice["candidates"], choice["rule"]
    if file.kind == "planner":
        steps = file.shape["replan_every"]
        plans, values = planner.plan(file, observations, inputs["noise"], candidates)
        taken = choose(plans, values, rule, candidates, inputs.get("uniform")).reshape(-1, steps, a)
        plan = to_user(file, taken)
        first = {"actions": (plan.at(1, 0), (a,)), "values": (values, (candidates,))}
        return graph.model({**first, "plan": (plan, (steps, a))} if steps > 1 else {**first}, repr(policy))
    guidance = {"guidance": choice["guidance"]} if choice["guidance"] else {}
    actions = DRAW[file.kind](file, observations, inputs["noise"], candidates, **guidance)
    beside: dict[str, tuple[Value, tuple[int, ...]]] = {}
    if file.shape.get("critics") != 0:
        values, scores = critics(file, choice, observations, actions)
        beside["values"] = values, (candidates,)
        actions = choose(actions, scores, rule, candidates, inputs.get("uniform"))
    shape = (chunk["length"], a) if chunk else (a,)
    metadata = {"chunk": chunk["length"], "replan": chunk["replan"]} if chunk else {}
    taken = to_user(file, actions.reshape(-1, *shape))
    return graph.model({"actions": (taken, shape), **beside}, repr(policy), **metadata)
