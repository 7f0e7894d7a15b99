"""Shared by the algorithms: networks, Adam, averages, and random numbers to start from.

Networks and their gradients are JAX in float64; everything else is NumPy. Parameters are a dictionary of arrays named
as in the files, kernels [in, out].
"""

import inspect
import math
import os
import re

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
# Compiling takes longer than running.
jax.config.update("jax_disable_most_optimizations", True)

ADAM = {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-8}


def compiled(function):
    """The function, compiled once for each shape of its arguments, each activation, and each number of groups or heads of
    attention; it gives NumPy arrays.
    """
    static = [name for name in inspect.signature(function).parameters if name.endswith(("activation", "groups", "attention", "after"))]
    fast = jax.jit(function, static_argnames=static)
    return lambda *arguments: jax.tree.map(np.asarray, fast(*arguments))


# Networks. An activation goes by its name; layers, and whether they are normalized, follow from the parameters' names.


def mish(x):
    return x * jnp.tanh(jnp.logaddexp(x, 0.0))


def gelu(x):
    return 0.5 * x * (1 + jnp.tanh(math.sqrt(2 / math.pi) * (x + 0.044715 * x**3)))


ACTIVATIONS = {"mish": mish, "relu": jax.nn.relu, "silu": jax.nn.silu, "tanh": jnp.tanh, "gelu": gelu}


def normalized(x, epsilon):
    """Mean 0 and variance 1 over the last axis."""
    return (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + epsilon)


def mlp(parameters, prefix, activation, x, epsilon=1e-6, after=False):
    """Layers; what is normalized is before its activation, or after."""
    last = sum(bool(re.fullmatch(rf"{prefix}\d+\.kernel", name)) for name in parameters) - 1
    for i in range(last + 1):
        x = x @ parameters[f"{prefix}{i}.kernel"] + parameters[f"{prefix}{i}.bias"]
        if i == last:
            return x
        x = ACTIVATIONS[activation](x) if after else x
        if f"{prefix}{i}.scale" in parameters:
            x = parameters[f"{prefix}{i}.scale"] * normalized(x, epsilon) + parameters[f"{prefix}{i}.shift"]
        x = x if after else ACTIVATIONS[activation](x)


def ensemble(networks, x, activation, epsilon=1e-6, after=False):
    """The outputs of all members of an ensemble of MLPs for the same inputs [..., in], as [K, ..., out]."""
    return jax.vmap(lambda network: mlp(network, "", activation, x, epsilon, after))(networks)


def values(critics, states, actions, activation, epsilon=1e-6, after=False):
    """Q_k(s, a) of the whole ensemble, [K, ...]."""
    return ensemble(critics, jnp.concatenate([states, actions], -1), activation, epsilon, after)[..., 0]


fast_values = compiled(values)


# Optimization.


def clip_by_norm(gradients, limit):
    """Clipping by the global norm; also the norm before it."""
    norm = math.sqrt(sum(np.sum(g**2) for g in gradients.values()))
    return {name: g * np.minimum(1.0, limit / norm) for name, g in gradients.items()}, norm


def decayed(rate, config, online=1.0):
    """Cosine decay from the start value to 0 over the steps on the dataset alone; a share of it in those online."""
    if config["step"] >= config["total_steps"]:
        return rate * online
    return rate * 0.5 * (1 + math.cos(math.pi * config["step"] / config["total_steps"]))


def adam_step(state, name, gradients, rate, step, weight_decay=0.0):
    """The network called name and its moments after a step of Adam (AdamW, with weight decay); steps count from 0."""
    beta1, beta2 = ADAM["beta1"], ADAM["beta2"]
    m = {n: beta1 * x + (1 - beta1) * gradients[n] for n, x in state[f"adam_m.{name}"].items()}
    v = {n: beta2 * x + (1 - beta2) * gradients[n] ** 2 for n, x in state[f"adam_v.{name}"].items()}
    unbias1, unbias2 = 1 / (1 - beta1 ** (step + 1)), 1 / (1 - beta2 ** (step + 1))
    moves = {n: rate * m[n] * unbias1 / (np.sqrt(v[n] * unbias2) + ADAM["epsilon"]) for n in m}
    moved = {n: x * (1 - rate * weight_decay) - moves[n] for n, x in state[name].items()}
    return {name: moved, f"adam_m.{name}": m, f"adam_v.{name}": v}


def follow(target, online, rate):
    return {name: (1 - rate) * target[name] + rate * online[name] for name in target}


def shape(hidden, activation="mish", norm=False):
    """A network's shape, as configurations describe it."""
    return {"hidden": hidden, "activation": activation, "norm": norm}


def configuration(algorithm, batch_size, step, agent):
    """A folder's config.json, at Hopper's sizes."""
    return {
        "algorithm": algorithm,
        "observation_dim": 11,
        "action_dim": 3,
        "batch_size": batch_size,
        "total_steps": 2000,
        "step": step,
        "adam": ADAM,
        "agent": agent,
    }


# Random numbers, rounded to float32 before anything is computed from them: both sides start from the same values.


def single(x):
    return np.asarray(x, np.float32).astype(np.float64)


def random_network(rng, inputs, shape, outputs, members=None, prefix=""):
    """An MLP of a shape as in configurations; an ensemble's parameters have its count of members in front."""
    front = () if members is None else (members,)
    widths = [inputs, *shape["hidden"], outputs]
    network = {}
    for i, (rows, columns) in enumerate(zip(widths, widths[1:], strict=False)):
        limit = math.sqrt(6 / (rows + columns))
        network[f"{prefix}{i}.kernel"] = single(rng.uniform(-limit, limit, (*front, rows, columns)))
        network[f"{prefix}{i}.bias"] = single(rng.uniform(-0.1, 0.1, (*front, columns)))
        if shape["norm"] and i < len(shape["hidden"]):
            network[f"{prefix}{i}.scale"] = single(rng.uniform(0.5, 1.5, (*front, columns)))
            network[f"{prefix}{i}.shift"] = single(rng.uniform(-0.3, 0.3, (*front, columns)))
    return network


def random_batch(rng, config):
    o, a, b = config["observation_dim"], config["action_dim"], config["batch_size"]
    return {
        "observations": single(rng.normal(size=(b, o))),
        "actions": single(rng.uniform(-0.99999, 0.99999, (b, a))),
        "rewards": single(rng.normal(size=b)),
        "next_observations": single(rng.normal(size=(b, o))),
        "masks": (np.arange(b) % 4 != 3).astype(np.float64),
    }


def near(rng, network):
    """A target network: not far from the network that it follows."""
    return {name: single(x + 0.05 * rng.normal(size=x.shape)) for name, x in network.items()}


def random_moments(rng, name, network):
    """Adam's moments, of the size that gradients of norm 1 or so would give them."""
    typical = 1 / math.sqrt(sum(x.size for x in network.values()))
    return {
        f"adam_m.{name}": {n: single(0.3 * typical * rng.normal(size=x.shape)) for n, x in network.items()},
        f"adam_v.{name}": {n: single(typical**2 * rng.uniform(0.2, 2, x.shape)) for n, x in network.items()},
    }
