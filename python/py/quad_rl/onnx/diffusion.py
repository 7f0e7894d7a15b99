"""Samples of a diffusion policy: the reverse process of a noise predictor, unrolled, with the constants of each step."""

import math

import numpy as np

from quad_rl.onnx.file import Array, File
from quad_rl.onnx.graph import Value
from quad_rl.onnx.mlp import action_gradient, layers, mish


def embeddings(file: File, steps: int) -> Array:
    """Embeddings of t = 1..T: cosines and sines through two layers."""
    angles = np.arange(1, steps + 1)[:, None] * np.exp(-np.arange(8) * math.log(10_000) / 7)
    features = np.concatenate([np.cos(angles), np.sin(angles)], 1)
    kernels, biases = ([file[f"actor.time.{i}.{kind}"] for i in range(2)] for kind in ("kernel", "bias"))
    embedded: Array = mish(features @ kernels[0] + biases[0]) @ kernels[1] + biases[1]
    return embedded


def cosine(steps: int) -> Array:
    """α_t of the cosine schedule for t = 1..T."""
    falls = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    alpha: Array = np.maximum(falls[1:] / falls[:-1], 0.001)
    return alpha


def draw(file: File, observations: Value, noise: Value, candidates: int, guidance: float = 0.0) -> Value:
    o, a, steps, reverse = (file.shape[name] for name in ("observation_dim", "action_dim", "diffusion_steps", "reverse"))
    kernel, bias = file["actor.trunk.0.kernel"], file["actor.trunk.0.bias"]
    shifts = embeddings(file, steps) @ kernel[o + a :] + bias
    state = (observations @ kernel[:o]).reshape(-1, 1, kernel.shape[1])
    exponent = -0.1 / steps - 0.5 * 9.9 * (2 * np.arange(1, steps + 1) - 1) / steps**2
    alpha = cosine(steps) if reverse == "cosine" else np.exp(exponent)
    bar = np.cumprod(np.concatenate([[1.0], alpha]))
    x = noise.at(1, 0)
    for t in range(steps, 0, -1):
        first = (x.reshape(-1, a) @ kernel[o : o + a]).reshape(-1, candidates, kernel.shape[1]) + state + shifts[t - 1]
        epsilon = layers(file, "actor.trunk.", file.shape["actor"], first)
        clean = (x - epsilon * math.sqrt(1 - bar[t])) * (1 / math.sqrt(bar[t]))
        if guidance:
            pull = action_gradient(file, "critic.", file.shape["critic"], observations, clean.clip(-1.0, 1.0), candidates)
            clean = clean + pull * (guidance * (1 - bar[t]) / math.sqrt(bar[t]))
        clean = clean if reverse == "clip-sample" else clean.clip(-1.0, 1.0)
        ahead, beta = bar[t - 1], 1 - alpha[t - 1]
        x = clean * (math.sqrt(ahead) * beta / (1 - bar[t])) + x * (math.sqrt(1 - beta) * (1 - ahead) / (1 - bar[t]))
        if t > 1:
            shrink = (1 - ahead) / (1 - bar[t]) if reverse in ("posterior", "cosine") else 1.0
            x = x + noise.at(1, steps - t + 1) * math.sqrt(beta * shrink)
        x = x.clip(-1.0, 1.0) if reverse == "clip-sample" else x
    return x
