"""Samples of a squashed Gaussian policy: tanh of normal numbers with a network's mean and log σ."""

from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import state_outputs


def draw(file: File, observations: Value, noise: Value, candidates: int) -> Value:
    a = file.shape["action_dim"]
    out = state_outputs(file, "actor.", file.shape["actor"], observations).reshape(-1, 1, 2 * a)
    deviation = noise.graph("Exp", out.slice(2, a, 2 * a).clip(-5.0, 2.0))
    return noise.graph("Tanh", noise.at(1, 0) * deviation + out.slice(2, 0, a))
