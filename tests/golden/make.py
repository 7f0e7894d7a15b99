"""Golden numbers: one update of QUAD, written a second time with JAX in float64.

    make.py --seed N --out DIR [--variant quad|dac|maxq|none] [--size small|hopper]
    make.py --check

Writes a folder as docs/golden.md describes it. Nothing here is taken from the Rust side: it is written from the paper
(equation numbers below are the paper's) and that page.
"""

import argparse
import functools
import json
import math
import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import save_file

jax.config.update("jax_enable_x64", True)

ADAM = {"beta1": 0.9, "beta2": 0.999, "epsilon": 1e-8}
TIME_FEATURES, TIME_EMBEDDING = 16, 32

# Large rates, so that a mistake in an optimiser or an average is far larger than float32's rounding.
AGENT = {
    "diffusion_steps": 5,
    "gamma": 0.99,
    "rho": 1.5,
    "guidance": "quad",
    "tau": 0.5,
    "delta": 1e-3,
    "target_reduce": "mean",
    "eta": {"initial": 1.0, "threshold": 0.7, "rate": 0.05, "minimum": 1e-3, "maximum": 100.0},
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "gradient_clip": 0.5,
    "ema_rate": 0.05,
    "nu_ema_rate": 0.1,
    "actor_ema_every": 5,
    "actor_ema_start": 1000,
}
SIZES = {
    # Narrow and odd, so that no row is a whole number of vector registers.
    "small": {"hidden": 11, "critics": 3, "batch_size": 8, "samples": 2},
    "hopper": {"hidden": 256, "critics": 10, "batch_size": 256, "samples": 10},
}
SELECT = {"small": 6, "hopper": 32}
CONSTANT_ETA = {"initial": 0.1, "rate": 0.05, "minimum": 1e-3, "maximum": 100.0}
# An early step, where Adam's bias correction is large, and a late one, where the learning rate has decayed.
STEPS = {"quad": 1234, "dac": 1234, "maxq": 4, "none": 1234}
VARIANTS = {
    "quad": {},
    "dac": {"guidance": "dac", "gradient_clip": 100.0},
    "maxq": {"target_reduce": "max", "eta": CONSTANT_ETA, "samples": 3, "rho": 1.0, "tau": 10.0, "actor_ema_start": 4},
    "none": {"guidance": "none"},
}


def make_config(variant, size):
    return {
        "observation_dim": 11,
        "action_dim": 3,
        "candidates": 10,
        "total_steps": 2000,
        "step": STEPS[variant],
        "adam": ADAM,
        "agent": AGENT | SIZES[size] | VARIANTS[variant],
    }


# Networks. Parameters are a dictionary of arrays named as in the files, kernels [in, out].


def mish(x):
    return x * jnp.tanh(jnp.logaddexp(x, 0.0))


def mlp(parameters, prefix, layers, x):
    for i in range(layers):
        x = x @ parameters[f"{prefix}{i}.kernel"] + parameters[f"{prefix}{i}.bias"]
        x = mish(x) if i < layers - 1 else x
    return x


def predict_noise(actor, states, noisy_actions, t):
    """ε_θ(s, a^t, t), shapes [..., o], [..., a], [...]."""
    frequencies = jnp.exp(-jnp.arange(8) * math.log(10_000) / 7)
    angles = t[..., None] * frequencies
    features = jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], -1)
    time = mlp(actor, "time.", 2, features)
    return mlp(actor, "trunk.", 4, jnp.concatenate([states, noisy_actions, time], -1))


def values(critics, states, actions):
    """Q_k(s, a) of the whole ensemble, [K, ...]."""
    inputs = jnp.concatenate([states, actions], -1)
    return jax.vmap(lambda critic: mlp(critic, "", 4, inputs)[..., 0])(critics)


def action_gradients(critics, states, actions):
    """∂Q_k/∂a for each critic and row, [K, B, a]; rows do not depend on one another, so their sum will do."""

    def total(critic, actions):
        return mlp(critic, "", 4, jnp.concatenate([states, actions], -1)).sum()

    return jax.vmap(jax.grad(total, 1), (0, None))(critics, actions)


# Diffusion. Arrays over t have T + 1 entries, so that index t is step t; ᾱ_0 = 1.


def schedule(steps):
    t = np.arange(1, steps + 1)
    beta = np.concatenate([[0.0], 1 - np.exp(-0.1 / steps - 0.5 * (10 - 0.1) * (2 * t - 1) / steps**2)])
    return jnp.array(beta), jnp.cumprod(1 - jnp.array(beta))


def denoise(actor, states, noisy_actions, t, steps):
    """x0 and the mean of one reverse step at the whole number t, without its noise."""
    beta, alpha_bar = schedule(steps)
    epsilon = predict_noise(actor, states, noisy_actions, jnp.full(states.shape[:-1], t))
    x0 = (noisy_actions - jnp.sqrt(1 - alpha_bar[t]) * epsilon) / jnp.sqrt(alpha_bar[t])
    x0 = jnp.clip(x0, -1, 1)
    of_x0 = jnp.sqrt(alpha_bar[t - 1]) * beta[t]
    of_noisy = jnp.sqrt(1 - beta[t]) * (1 - alpha_bar[t - 1])
    return x0, (of_x0 * x0 + of_noisy * noisy_actions) / (1 - alpha_bar[t])


def sample(actor, states, noise):
    """Actions for states [..., n, o] with noise [T, ..., n, samples, a]."""
    steps = len(noise)
    beta, _ = schedule(steps)
    states = jnp.broadcast_to(states[..., None, :], noise.shape[1:-1] + states.shape[-1:])
    actions = noise[0]
    for t in range(steps, 0, -1):
        _, actions = denoise(actor, states, actions, t, steps)
        if t > 1:
            actions += jnp.sqrt(beta[t]) * noise[steps - t + 1]
    return actions


# One update.


def critic_loss(critics, states, actions, targets):
    return jnp.mean((values(critics, states, actions) - targets) ** 2)


def actor_loss(actor, states, noisy_actions, t, epsilon, eta, weight, gradient):
    """Eq. 19, given weight λ·w(t) [B, 1] and the normalised gradient ḡ [B, a]; also its two terms."""
    predicted = predict_noise(actor, states, noisy_actions, t)
    bc = jnp.mean((epsilon - predicted) ** 2)
    guidance = jnp.mean(weight * predicted * gradient)
    return eta * bc + guidance, (bc, guidance)


def adam_step(config, rate, parameters, gradients, m, v):
    """Clipping by the global norm, then Adam with a decaying rate; also the norm before clipping."""
    norm = jnp.sqrt(sum(jnp.sum(g**2) for g in gradients.values()))
    scale = jnp.minimum(1.0, config["agent"]["gradient_clip"] / norm)
    step, beta1, beta2 = config["step"], ADAM["beta1"], ADAM["beta2"]
    rate *= 0.5 * (1 + math.cos(math.pi * step / config["total_steps"]))
    m = {name: beta1 * m[name] + (1 - beta1) * scale * g for name, g in gradients.items()}
    v = {name: beta2 * v[name] + (1 - beta2) * (scale * g) ** 2 for name, g in gradients.items()}
    correct1, correct2 = 1 - beta1 ** (step + 1), 1 - beta2 ** (step + 1)
    move = {name: rate * m[name] / correct1 / (jnp.sqrt(v[name] / correct2) + ADAM["epsilon"]) for name in m}
    return {name: value - move[name] for name, value in parameters.items()}, m, v, norm


def follow(target, online, rate):
    return {name: (1 - rate) * target[name] + rate * online[name] for name in target}


def update(config, state, inputs):
    agent = config["agent"]
    steps, eta = agent["diffusion_steps"], state["eta"][0]
    beta, alpha_bar = schedule(steps)
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))
    out = {"schedule.beta": beta[1:], "schedule.alpha_bar": alpha_bar[1:]}

    # Target values, Eq. 20.
    next_actions = sample(state["target_actor"], inputs["next_observations"], inputs["next_noise"])
    next_states = jnp.broadcast_to(
        inputs["next_observations"][:, None], next_actions.shape[:2] + inputs["next_observations"].shape[1:]
    )
    q = values(state["target_critic"], next_states, next_actions)  # [K, B, S]
    lcb = q.mean(0) - agent["rho"] * q.std(0)
    next_value = {"mean": lcb.mean(-1), "max": lcb.max(-1)}[agent["target_reduce"]]
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * next_value
    out |= {"next_actions": next_actions, "targets": targets}

    # Critics, and their targets.
    loss, gradients = jax.value_and_grad(critic_loss)(state["critic"], s, a, targets)
    m, v = state["adam_m.critic"], state["adam_v.critic"]
    critic, m, v, norm = adam_step(config, agent["critic_learning_rate"], state["critic"], gradients, m, v)
    target_critic = follow(state["target_critic"], critic, agent["ema_rate"])
    out |= {"critic_loss": loss, "critic_gradient_norm": norm, "critic": critic, "target_critic": target_critic}
    out |= {"adam_m.critic": m, "adam_v.critic": v}

    # Noisy actions, Eq. 5.
    noise_level = jnp.sqrt(1 - alpha_bar[t])[:, None]  # also w(t)
    noisy = jnp.sqrt(alpha_bar[t])[:, None] * a + noise_level * epsilon
    out["noisy_actions"] = noisy

    # Guidance, Eq. 10 and 21-24, with the critics' new targets.
    nu_squared = state["nu_squared"][0]
    if agent["guidance"] == "none":
        weight, mean_gradient = jnp.zeros((len(s), 1)), jnp.zeros_like(a)
    else:
        gradients = action_gradients(target_critic, s, noisy)
        q_scale = jnp.abs(values(target_critic, s, a).mean(0)).mean() + 1e-6
        g = gradients / q_scale
        predicted = predict_noise(state["actor"], s, noisy, t)
        u = predicted / (jnp.linalg.norm(predicted, axis=-1, keepdims=True) + 1e-8)
        alignment = (u * g).sum(-1)  # [K, B]
        sigma_squared = alignment.var(0)
        batch_nu = alignment.mean(0).var()
        rate = agent["nu_ema_rate"]
        nu_squared = jnp.where(nu_squared < 0, batch_nu, (1 - rate) * nu_squared + rate * batch_nu)
        uncertain = nu_squared / (nu_squared + sigma_squared / agent["tau"] + agent["delta"])
        weights = uncertain if agent["guidance"] == "quad" else jnp.ones(len(s))
        weight, mean_gradient = weights[:, None] * noise_level, g.mean(0)
        out |= {"critic_action_gradients": gradients, "q_scale": q_scale, "u": u}
        out |= {"sigma_squared": sigma_squared, "lambda": weights}
    out["nu_squared"] = nu_squared

    # Actor, Eq. 19.
    arguments = (s, noisy, t, epsilon, eta, weight, mean_gradient)
    (loss, (bc, guidance)), gradients = jax.value_and_grad(actor_loss, has_aux=True)(state["actor"], *arguments)
    m, v = state["adam_m.actor"], state["adam_v.actor"]
    actor, m, v, norm = adam_step(config, agent["actor_learning_rate"], state["actor"], gradients, m, v)
    out |= {"actor_loss": loss, "bc_loss": bc, "guidance_loss": guidance, "actor_gradient_norm": norm, "actor": actor}
    out |= {"adam_m.actor": m, "adam_v.actor": v}

    # Dual ascent on η, and the target actor.
    if "threshold" in agent["eta"]:
        _, (bc, _) = actor_loss(actor, *arguments)
        eta += agent["eta"]["rate"] * jnp.clip(bc - agent["eta"]["threshold"], -1, 1)
        eta = jnp.clip(eta, agent["eta"]["minimum"], agent["eta"]["maximum"])
    done = config["step"] + 1
    follows = done % agent["actor_ema_every"] == 0 and done > agent["actor_ema_start"]
    target_actor = follow(state["target_actor"], actor, agent["ema_rate"]) if follows else state["target_actor"]
    return out | {"eta": eta, "target_actor": target_actor}


def act(state, inputs):
    """Eq. 25, and single reverse steps, with the target networks as they are before the update."""
    states, noise = inputs["select_observations"], inputs["select_noise"]
    candidates = sample(state["target_actor"], states, noise)
    repeated = jnp.broadcast_to(states[:, None], candidates.shape[:2] + states.shape[1:])
    q = values(state["target_critic"], repeated, candidates).mean(0)
    index = q.argmax(-1)
    steps = len(noise)
    reverse = [
        denoise(state["target_actor"], inputs["observations"], inputs["denoise_actions"][t - 1], t, steps)
        for t in range(1, steps + 1)
    ]
    return {
        "denoise.x0": jnp.stack([x0 for x0, _ in reverse]),
        "denoise.mean": jnp.stack([mean for _, mean in reverse]),
        "select.q": q,
        "select.index": index,
        "select.actions": candidates[jnp.arange(len(states)), index],
    }


# Random states and inputs. Everything is rounded to float32 first, so that both sides start from the same numbers.


def single(x):
    return np.asarray(x, np.float32).astype(np.float64)


def random_network(rng, shapes):
    network = {}
    for name, (*ensemble, rows, columns) in shapes.items():
        limit = math.sqrt(6 / (rows + columns))
        network[f"{name}.kernel"] = single(rng.uniform(-limit, limit, (*ensemble, rows, columns)))
        network[f"{name}.bias"] = single(rng.uniform(-0.1, 0.1, (*ensemble, columns)))
    return network


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    hidden, k = agent["hidden"], agent["critics"]
    trunk = [o + a + TIME_EMBEDDING, hidden, hidden, hidden, a]
    critic = [o + a, hidden, hidden, hidden, 1]
    actor_shapes = {"time.0": (TIME_FEATURES, TIME_EMBEDDING), "time.1": (TIME_EMBEDDING, TIME_EMBEDDING)}
    actor_shapes |= {f"trunk.{i}": (trunk[i], trunk[i + 1]) for i in range(4)}
    critic_shapes = {f"{i}": (k, critic[i], critic[i + 1]) for i in range(4)}
    state = {"actor": random_network(rng, actor_shapes), "critic": random_network(rng, critic_shapes)}
    for name in "actor", "critic":
        network = state[name]
        # Gradients are clipped to norm 1, which gives the moments their size.
        typical = 1 / math.sqrt(sum(x.size for x in network.values()))
        state[f"target_{name}"] = {n: single(x + 0.05 * rng.normal(size=x.shape)) for n, x in network.items()}
        state[f"adam_m.{name}"] = {n: single(0.3 * typical * rng.normal(size=x.shape)) for n, x in network.items()}
        state[f"adam_v.{name}"] = {n: single(typical**2 * rng.uniform(0.2, 2, x.shape)) for n, x in network.items()}
    state["eta"] = single([agent["eta"]["initial"]])
    state["nu_squared"] = single([-1.0 if agent["target_reduce"] == "max" else 0.5])
    return state


def random_inputs(config, rng, size, state):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    steps, b, n = agent["diffusion_steps"], agent["batch_size"], SELECT[size]
    inputs = {
        "observations": single(rng.normal(size=(b, o))),
        "actions": single(rng.uniform(-0.99999, 0.99999, (b, a))),
        "rewards": single(rng.normal(size=b)),
        "next_observations": single(rng.normal(size=(b, o))),
        "masks": (np.arange(b) % 4 != 3).astype(np.float64),
        "next_noise": single(rng.normal(size=(steps, b, agent["samples"], a))),
        "t": rng.permutation(np.arange(b) % steps + 1),
        "epsilon": single(rng.normal(size=(b, a))),
        "denoise_actions": single(rng.normal(size=(steps, b, a))),
        "select_observations": single(rng.normal(size=(n, o))),
    }
    # A choice between candidates of nearly equal value would depend on rounding: draw such states' noise again.
    noise = np.zeros((steps, n, config["candidates"], a))
    close = np.full(n, True)
    compiled = jax.jit(act)
    while close.any():
        noise[:, close] = single(rng.normal(size=noise[:, close].shape))
        q = np.sort(np.asarray(compiled(state, inputs | {"select_noise": noise})["select.q"]))
        close = q[:, -1] - q[:, -2] < 1e-3
    return inputs | {"select_noise": noise}


def flatten(tree):
    """The tensors of a file: names joined by dots, float32 unless whole numbers, scalars as [1]."""
    flat = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{inner}": x for inner, x in flatten(value).items()}
        else:
            value = np.atleast_1d(np.asarray(value))
            flat[name] = value.astype(np.int64 if np.issubdtype(value.dtype, np.integer) else np.float32)
    return flat


def make(seed, variant, size):
    config, rng = make_config(variant, size), np.random.default_rng(seed)
    state = random_state(config, rng)
    inputs = random_inputs(config, rng, size, state)
    expected = jax.jit(functools.partial(update, config))(state, inputs) | jax.jit(act)(state, inputs)
    return config, state, inputs, expected


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder to write")
    parser.add_argument("--variant", choices=VARIANTS, default="quad")
    parser.add_argument("--size", choices=SIZES, default="small")
    parser.add_argument("--check", action="store_true", help="compare gradients with finite differences")
    arguments = parser.parse_args()
    if arguments.check:
        from check import check

        check()
    if arguments.out:
        config, state, inputs, expected = make(arguments.seed, arguments.variant, arguments.size)
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "config.json").write_text(json.dumps(config, indent=2) + "\n")
        for name, tensors in ("state", state), ("inputs", inputs), ("expected", expected):
            save_file(flatten(tensors), arguments.out / f"{name}.safetensors")
    elif not arguments.check:
        parser.error("nothing to do: give --out DIR, --check or both")


if __name__ == "__main__":
    main()
