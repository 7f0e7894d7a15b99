"""The Gaussian policy, which acts by its mean."""

from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import of_states


def mean(file: File, observations: Value) -> Value:
    return observations.graph("Tanh", of_states(file, "actor.", file.shape["actor"], observations).at(0, 0))
