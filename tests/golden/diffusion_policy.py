"""One update of Diffusion Policy (Chi et al. 2023): cloning by a noise predictor on the cosine schedule, and its EMA. Of chunks it
clones all actions, also the copies beyond the end of an episode.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from diffusion import fast_noise, predict_noise, random_predictor, repeated
from fql import joined, width, windows
from networks import adam_step, compiled, configuration, follow, near, random_batch, random_moments, shape, single

SIZES = {
    "narrow": {"hidden": 5, "batch_size": 23, "select": 3},
    "small": {"hidden": 7, "batch_size": 24, "select": 6},
    "hopper": {"hidden": 256, "batch_size": 256, "select": 32},
}
# Large rates, so that a mistake in an optimizer or an average is far larger than float32's rounding.
AGENT = {"diffusion_steps": 6, "learning_rate": 0.02, "warmup": 50, "weight_decay": 0.5}
FOLDERS = {"diffusion-policy": (60, "small"), "diffusion-policy-chunks": (61, "small")}
# The second is in the warm-up.
STEPS = {"diffusion-policy": 700, "diffusion-policy-chunks": 30}


def make_config(variant, size):
    agent = {"actor": shape([SIZES[size]["hidden"]] * 3)} | AGENT
    chunk = {"chunk": 3, "replan": 2} if variant == "diffusion-policy-chunks" else {}
    return configuration("diffusion-policy", SIZES[size]["batch_size"], STEPS[variant], agent | chunk)


def schedule(steps):
    """β_t and ᾱ_t of t = 0 … T."""
    signal = [math.cos((t / steps + 0.008) / 1.008 * math.pi / 2) ** 2 for t in range(steps + 1)]
    beta = np.array([0.0] + [np.minimum(1 - after / before, 0.999) for before, after in zip(signal, signal[1:], strict=False)])
    return beta, np.cumprod(1 - beta)


def bc_loss(actor, states, noisy, t, epsilon, activation):
    return jnp.mean((epsilon - predict_noise(actor, states, noisy, t, activation)) ** 2)


bc_gradient = compiled(jax.value_and_grad(bc_loss))


def update(config, state, inputs):
    """All that must come out, and nothing else."""
    agent, step = config["agent"], config["step"]
    _, alpha_bar = schedule(agent["diffusion_steps"])
    (s, t, epsilon), a = (inputs[name] for name in ("observations", "t", "epsilon")), windows(config, inputs)[0]
    noisy = np.sqrt(alpha_bar[t])[:, None] * a + np.sqrt(1 - alpha_bar[t])[:, None] * epsilon
    loss, gradients = bc_gradient(state["actor"], s, noisy, t, epsilon, agent["actor"]["activation"])
    rises, falls = step / agent["warmup"], (step - agent["warmup"]) / (config["total_steps"] - agent["warmup"])
    rate = agent["learning_rate"] * (rises if step < agent["warmup"] else 0.5 * (1 + math.cos(math.pi * falls)))
    out = {"bc_loss": loss} | adam_step(state, "actor", gradients, rate, step, agent["weight_decay"])
    # The first two updates copy.
    decay = min(1 - max(step, 1) ** -0.75, 0.9999)
    return out | {"target_actor": follow(state["target_actor"], out["actor"], 1 - decay)}, None


def act(config, state, inputs):
    """The EMA's draws from each state."""
    noise, steps = inputs["select_noise"], config["agent"]["diffusion_steps"]
    (beta, alpha_bar), states, x = schedule(steps), repeated(inputs["select_observations"], noise), noise[0]
    for t in range(steps, 0, -1):
        epsilon = fast_noise(state["target_actor"], states, x, np.full(x.shape[:-1], t), config["agent"]["actor"]["activation"])
        clean = np.clip((x - np.sqrt(1 - alpha_bar[t]) * epsilon) / np.sqrt(alpha_bar[t]), -1, 1)
        mean = np.sqrt(alpha_bar[t - 1]) * beta[t] * clean + np.sqrt(1 - beta[t]) * (1 - alpha_bar[t - 1]) * x
        x = mean / (1 - alpha_bar[t])
        if t > 1:
            x = x + np.sqrt(beta[t] * (1 - alpha_bar[t - 1]) / (1 - alpha_bar[t])) * noise[steps - t + 1]
    return {"select.actions": x[:, 0]}


def random_state(config, rng):
    actor = random_predictor(rng, config["observation_dim"], width(config), config["agent"]["actor"])
    return {"actor": actor, "target_actor": near(rng, actor)} | random_moments(rng, "actor", actor)


def random_inputs(config, rng, size):
    o, a, b, n = config["observation_dim"], width(config), config["batch_size"], SIZES[size]["select"]
    steps, batch = config["agent"]["diffusion_steps"], random_batch(rng, config)
    return (joined(batch) if "chunk" in config["agent"] else batch) | {
        "t": rng.permutation(np.arange(b) % steps + 1),
        "epsilon": single(rng.normal(size=(b, a))),
        "select_observations": single(rng.normal(size=(n, o))),
        "select_noise": single(rng.normal(size=(steps, n, 1, a))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out."""
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    return state, inputs, update(config, state, inputs)[0] | act(config, state, inputs)
