"""Samples of a flow: Euler steps of a velocity, from noise at time 0 to actions at time 1."""

from quad_rl.onnx.file import File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import layers


def draw(file: File, observations: Value, noise: Value, candidates: int) -> Value:
    a, (kernel,), (bias,) = file.shape["action_dim"], file["actor.0.kernel"], file["actor.0.bias"]
    state_kernel, position_kernel, time_kernel = kernel[: -a - 1], kernel[-a - 1 : -1], kernel[-1]
    state = (observations @ state_kernel + bias).reshape(-1, 1, len(bias))
    x = noise.at(1, 0)
    for step in range(file.flow_steps):
        position = (x.reshape(-1, a) @ position_kernel).reshape(-1, candidates, len(bias))
        first = (position + state + time_kernel * (step / file.flow_steps)).reshape(1, -1, len(bias))
        x = x + layers(file, "actor.", file.shape["actor"], first).reshape(-1, candidates, a) / float(file.flow_steps)
    return x.clip(-1.0, 1.0)
