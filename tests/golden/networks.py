"""What the algorithms share: networks, Adam, averages, and random numbers to start from.

Networks and their gradients are JAX in float64; everything else is NumPy. Parameters are a dictionary of arrays named
as in the files, kernels [in, out].
"""

import math
import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
# Compiling takes longer than running.
jax.config.update("jax_disable_most_optimizations", True)

ADAM = {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-8}


def compiled(function):
    """The function, compiled once for each shape of its arguments; it gives NumPy arrays."""
    fast = jax.jit(function)
    return lambda *arguments: jax.tree.map(np.asarray, fast(*arguments))


# Networks.


def mish(x):
    return x * jnp.tanh(jnp.logaddexp(x, 0.0))


def mlp(parameters, prefix, layers, x):
    for i in range(layers):
        x = x @ parameters[f"{prefix}{i}.kernel"] + parameters[f"{prefix}{i}.bias"]
        x = mish(x) if i < layers - 1 else x
    return x


def ensemble(networks, x):
    """The outputs of all members of an ensemble of MLPs for the same inputs [..., in], as [K, ..., out]."""
    return jax.vmap(lambda network: mlp(network, "", 4, x))(networks)


def values(critics, states, actions):
    """Q_k(s, a) of the whole ensemble, [K, ...]."""
    return ensemble(critics, jnp.concatenate([states, actions], -1))[..., 0]


# Optimisation.


def clip_by_norm(gradients, limit):
    """Clipping by the global norm; also the norm before it."""
    norm = math.sqrt(sum(np.sum(g**2) for g in gradients.values()))
    return {name: g * min(1.0, limit / norm) for name, g in gradients.items()}, norm


def decayed(rate, config):
    """Cosine decay from the start value to 0 over the whole run."""
    return rate * 0.5 * (1 + math.cos(math.pi * config["step"] / config["total_steps"]))


def adam_step(state, name, gradients, rate, step):
    """What Adam makes of the network called name and of its moments, in the update with this number, from 0."""
    beta1, beta2 = ADAM["beta1"], ADAM["beta2"]
    m = {n: beta1 * x + (1 - beta1) * gradients[n] for n, x in state[f"adam_m.{name}"].items()}
    v = {n: beta2 * x + (1 - beta2) * gradients[n] ** 2 for n, x in state[f"adam_v.{name}"].items()}
    unbias1, unbias2 = 1 / (1 - beta1 ** (step + 1)), 1 / (1 - beta2 ** (step + 1))
    moves = {n: rate * m[n] * unbias1 / (np.sqrt(v[n] * unbias2) + ADAM["epsilon"]) for n in m}
    return {name: {n: x - moves[n] for n, x in state[name].items()}, f"adam_m.{name}": m, f"adam_v.{name}": v}


def follow(target, online, rate):
    return {name: (1 - rate) * target[name] + rate * online[name] for name in target}


# Random numbers, rounded to float32 before anything is computed from them: both sides start from the same values.


def single(x):
    return np.asarray(x, np.float32).astype(np.float64)


def layers(widths, members=None, prefix=""):
    """Shapes of an MLP's kernels, those of an ensemble with its count of members in front."""
    front = () if members is None else (members,)
    return {f"{prefix}{i}": (*front, *pair) for i, pair in enumerate(zip(widths, widths[1:], strict=False))}


def random_network(rng, shapes):
    network = {}
    for name, (*members, rows, columns) in shapes.items():
        limit = math.sqrt(6 / (rows + columns))
        network[f"{name}.kernel"] = single(rng.uniform(-limit, limit, (*members, rows, columns)))
        network[f"{name}.bias"] = single(rng.uniform(-0.1, 0.1, (*members, columns)))
    return network


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
