"""Latency of one action and throughput of 1,000 observations, beside the policy's ONNX model in onnxruntime, which NumPy gives
its noise, and the same network in JAX (one jitted function), in one run.

    python python/benches/latency.py [SNAPSHOT]

Without a file of a diffusion policy that takes the best of its candidates, one of the paper's size is made with `learner`.
It needs jax (the version in tests/requirements.txt), onnx and onnxruntime.
"""

import json
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime
from safetensors import safe_open

import quad_rl


def paper_sized(folder):
    """A snapshot after one step on random data of Hopper's sizes."""
    rng, n = np.random.default_rng(0), 1000
    data = quad_rl.Dataset.from_arrays(
        observations=rng.normal(size=(n, 11)), actions=rng.uniform(-1, 1, (n, 3)), rewards=rng.normal(size=n),
        terminations=np.zeros(n), truncations=np.arange(n) % 100 == 99)
    data.save(folder / "data.hdf5")
    command = ["learner", "train", "--task", "own-data", "--steps", "1", "--dataset", folder / "data.hdf5", "--run-dir", folder / "run"]
    subprocess.run([*command, "--agent", "candidates=10"], check=True, capture_output=True)
    return next((folder / "run" / "snapshots").iterdir())


def in_jax(path):
    """act(key, observations) and value(observations, actions) of a policy's file."""
    with safe_open(path, "np") as file:
        tensors = {name: jnp.asarray(file.get_tensor(name)) for name in file.keys()}
        header = json.loads(file.metadata()["quad"])["policy"]
    shape, choice = header["shape"], header["choice"]
    assert header["kind"] == "diffusion" and choice["rule"] == "best" and shape["reverse"] == "clip-clean", header
    steps, a, candidates = shape["diffusion_steps"], shape["action_dim"], choice["candidates"]
    assert not shape["actor"]["norm"] and not shape["critic"]["norm"]
    activations = {"mish": jax.nn.mish, "relu": jax.nn.relu, "silu": jax.nn.silu, "tanh": jnp.tanh}
    t = np.arange(1, steps + 1)
    beta = np.concatenate([[0.0], 1 - np.exp(-0.1 / steps - 0.5 * 9.9 * (2 * t - 1) / steps**2)])
    bar = np.cumprod(1 - beta)
    frequencies = np.exp(-np.arange(8) * np.log(10_000) / 7)

    def mlp(tensors, prefix, activation, x, layers):
        for i in range(layers + 1):
            kernel, bias = tensors[f"{prefix}{i}.kernel"], tensors[f"{prefix}{i}.bias"]
            x = x @ kernel + (bias if bias.ndim == 1 else bias[:, None])
            x = activations[activation](x) if i < layers else x
        return x

    def values(tensors, observations, actions):
        x = jnp.concatenate([observations, actions], -1)
        q = mlp(tensors, "critic.", shape["critic"]["activation"], x, len(shape["critic"]["hidden"]))[..., 0]
        return q.mean(0) if choice["aggregate"] == "mean" else q.min(0)

    def act(tensors, key, observations):
        n = len(observations)
        states = jnp.repeat(observations, candidates, 0)
        noise = jax.random.normal(key, (steps, n * candidates, a))
        x = noise[0]
        for t in range(steps, 0, -1):
            features = np.concatenate([np.cos(t * frequencies), np.sin(t * frequencies)]).astype(np.float32)
            time = mlp(tensors, "actor.time.", "mish", features, 1)
            given = jnp.concatenate([states, x, jnp.broadcast_to(time, (len(x), len(time)))], -1)
            epsilon = mlp(tensors, "actor.trunk.", shape["actor"]["activation"], given, len(shape["actor"]["hidden"]))
            clean = jnp.clip((x - np.sqrt(1 - bar[t]) * epsilon) / np.sqrt(bar[t]), -1, 1)
            x = (np.sqrt(bar[t - 1]) * beta[t] * clean + np.sqrt(1 - beta[t]) * (1 - bar[t - 1]) * x) / (1 - bar[t])
            x = x + np.sqrt(beta[t]) * noise[steps - t + 1] if t > 1 else x
        best = values(tensors, states, x).reshape(n, candidates).argmax(1)
        return x.reshape(n, candidates, a)[jnp.arange(n), best]

    return partial(jax.jit(act), tensors), partial(jax.jit(values), tensors)


def in_onnx(policy, path):
    """act(observations) of its model."""
    quad_rl.export_onnx(policy, path)
    session, rng = onnxruntime.InferenceSession(path), np.random.default_rng(0)
    noise = policy.noise(1)["noise"].shape[1:]

    def act(observations):
        drawn = rng.standard_normal((len(observations), *noise), np.float32)
        return session.run(["actions"], {"observations": observations, "noise": drawn})[0]

    return act


def milliseconds(call, rounds):
    for i in range(10):
        call(i)
    times = []
    for i in range(rounds):
        start = time.perf_counter()
        call(i)
        times.append(1e3 * (time.perf_counter() - start))
    return np.median(times), np.percentile(times, 99)


def main():
    with tempfile.TemporaryDirectory() as folder:
        path = sys.argv[1] if len(sys.argv) > 1 else paper_sized(Path(folder))
        policy, (act, values) = quad_rl.Policy.load(path), in_jax(path)
        model = in_onnx(policy, Path(folder) / "policy.onnx")
    states = np.random.default_rng(1).normal(size=(1000, policy.observation_size)).astype(np.float32)
    actions = policy.act(states, seed=0)
    # The same networks, and the same distribution of actions.
    np.testing.assert_allclose(policy.value(states, actions), values(states, actions), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(actions.mean(0), np.asarray(act(jax.random.key(0), states)).mean(0), atol=0.15)

    keys = jax.random.split(jax.random.key(1), 1000)
    print(policy)
    for rows, rounds in ((1, 1000), (1000, 15)):
        for name, call in {
            "quad_rl": lambda i: policy.act(states[:rows], seed=i),
            "ONNX": lambda i: model(states[:rows]),
            "JAX": lambda i: np.asarray(act(keys[i], states[:rows])),
        }.items():
            median, p99 = milliseconds(call, rounds)
            print(f"{rows:5} observations  {name:8} median {median:8.3f} ms  p99 {p99:8.3f} ms  {1e3 * rows / median:9.0f} actions/s")


if __name__ == "__main__":
    main()
