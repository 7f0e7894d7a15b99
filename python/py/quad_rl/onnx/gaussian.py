"""The Gaussian policy, which acts by its mode."""

from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import state_outputs


def mode(file: File, observations: Value) -> Value:
    out = state_outputs(file, "actor.", file.shape["actor"], observations).at(0, 0)
    if file.shape.get("spread") == "squashed":  # log σ follows
        out = out.slice(1, 0, file.shape["action_dim"])
    return observations.graph("Tanh", out)
