"""Samples of a one-step policy: a network of state and noise."""

from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import action_outputs


def draw(file: File, observations: Value, noise: Value, candidates: int) -> Value:
    a = file.shape["action_dim"]
    drawn = action_outputs(file, "actor.", file.shape["actor"], observations, noise.at(1, 0), candidates, a)
    return drawn.at(0, 0).reshape(-1, candidates, a).clip(-1.0, 1.0)
