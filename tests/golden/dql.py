"""One update of Diffusion-QL (Wang, Hunt and Zhou 2022)."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from diffusion import predict_noise, random_predictor, repeated, schedule
from networks import (
    adam_step,
    clip_by_norm,
    compiled,
    configuration,
    fast_values,
    follow,
    near,
    random_batch,
    random_moments,
    random_network,
    shape,
    single,
    values,
)

CRITICS = 2
# Large rates, so that a mistake in an optimizer or an average is far larger than float32's rounding.
AGENT = {
    "diffusion_steps": 5,
    "gamma": 0.99,
    "eta": 1.5,
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "gradient_clip": 0.5,
    "ema_rate": 0.05,
    "actor_ema_rate": 0.02,
    "actor_ema_every": 5,
    "actor_ema_start": 1000,
    "temperature": 0.1,
    "candidates": 10,
}
SIZES = {
    "narrow": {"hidden": 5, "batch_size": 23, "select": 3},
    "small": {"hidden": 7, "batch_size": 24, "select": 6},
    "hopper": {"hidden": 256, "batch_size": 256, "select": 32},
}
# The step: the first at which the target actor moves, or the last of its turns before.
FOLDERS = {"dql": (18, "small"), "dql-max-backup": (19, "small")}
VARIANTS = {"dql": (1000, {"samples": 1}), "dql-max-backup": (995, {"samples": 10})}


def make_config(variant, size):
    networks = dict.fromkeys(("actor", "critic"), shape([SIZES[size]["hidden"]] * 3))
    step, agent = VARIANTS[variant]
    return configuration("dql", SIZES[size]["batch_size"], step, networks | AGENT | agent)


# The policy: the reverse chain, with the variance of the posterior.


def chain(actor, states, noise, activation):
    """Actions for states [..., o] with noise [T, ..., a]; and the x0 of each step before they are clipped."""
    steps = len(noise)
    beta, alpha_bar = schedule(steps)
    x, unclipped = noise[0], []
    for t in range(steps, 0, -1):
        epsilon = predict_noise(actor, states, x, jnp.full(states.shape[:-1], t), activation)
        unclipped.append((x - math.sqrt(1 - alpha_bar[t]) * epsilon) / math.sqrt(alpha_bar[t]))
        of_x0 = math.sqrt(alpha_bar[t - 1]) * beta[t] / (1 - alpha_bar[t])
        of_x = math.sqrt(1 - beta[t]) * (1 - alpha_bar[t - 1]) / (1 - alpha_bar[t])
        x = of_x0 * jnp.clip(unclipped[-1], -1, 1) + of_x * x
        if t > 1:
            variance = beta[t] * (1 - alpha_bar[t - 1]) / (1 - alpha_bar[t])
            x = x + math.sqrt(variance) * noise[steps - t + 1]
    return x, jnp.stack(unclipped)


fast_chain = compiled(chain)


# Losses and their gradients.


def critic_loss(critics, states, actions, targets, activation):
    """Each critic's mean squared error; their sum."""
    return jnp.sum(jnp.mean((values(critics, states, actions, activation) - targets) ** 2, -1))


def actor_loss(actor, critics, batch, eta, first, activation, critic_activation):
    """The denoising loss, and η times the negative Q of the policy's own actions; also those two, and the actions."""
    states, noisy, t, epsilon, noise = batch
    bc = jnp.mean((epsilon - predict_noise(actor, states, noisy, t, activation)) ** 2)
    actions, _ = chain(actor, states, noise, activation)
    q = values(critics, states, actions, critic_activation)
    q_loss = -q[first].mean() / jax.lax.stop_gradient(abs(q[1 - first]).mean())
    return bc + eta * q_loss, (bc, q_loss, actions)


critic_gradient = compiled(jax.value_and_grad(critic_loss))
actor_gradient = compiled(jax.value_and_grad(actor_loss, has_aux=True))


# One update.


def target_values(config, state, inputs):
    """Next actions [B, S, a] by the target actor, and the targets y [B]."""
    agent, noise = config["agent"], inputs["next_noise"]
    states = repeated(inputs["next_observations"], noise)
    actions, _ = fast_chain(state["target_actor"], states, noise, agent["actor"]["activation"])
    q = fast_values(state["target_critic"], states, actions, agent["critic"]["activation"])  # [K, B, S]
    # With one sample this is the smaller of the two; with more, each critic's largest comes first.
    return actions, inputs["rewards"] + agent["gamma"] * inputs["masks"] * q.max(-1).min(0)


def update(config, state, inputs):
    """All that must come out."""
    agent, step = config["agent"], config["step"]
    _, alpha_bar = schedule(agent["diffusion_steps"])
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))
    activations = agent["actor"]["activation"], agent["critic"]["activation"]

    next_actions, targets = target_values(config, state, inputs)
    out = {"next_actions": next_actions, "targets": targets, "target_q_mean": targets.mean()}

    # Critics.
    out["critic_loss"], gradients = critic_gradient(state["critic"], s, a, targets, activations[1])
    gradients, out["critic_gradient_norm"] = clip_by_norm(gradients, agent["gradient_clip"])
    out |= adam_step(state, "critic", gradients, agent["critic_learning_rate"], step)

    # Actor, with the critics that have just moved.
    out["noisy_actions"] = noisy = np.sqrt(alpha_bar[t])[:, None] * a + np.sqrt(1 - alpha_bar[t])[:, None] * epsilon
    batch = s, noisy, t, epsilon, inputs["policy_noise"]
    arguments = out["critic"], batch, agent["eta"], inputs["first_critic"][0], *activations
    (loss, (bc, q_loss, actions)), gradients = actor_gradient(state["actor"], *arguments)
    gradients, out["actor_gradient_norm"] = clip_by_norm(gradients, agent["gradient_clip"])
    out |= adam_step(state, "actor", gradients, agent["actor_learning_rate"], step)
    out |= {"actor_loss": loss, "bc_loss": bc, "q_loss": q_loss, "policy_actions": actions}

    # Targets: the actor's on its turns only.
    follows = step % agent["actor_ema_every"] == 0 and step >= agent["actor_ema_start"]
    target = state["target_actor"]
    out["target_actor"] = follow(target, out["actor"], agent["actor_ema_rate"]) if follows else target
    out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])
    return out, None


def act(config, state, inputs):
    """The values of the online actor's candidates, and the probability that each is drawn, before the update."""
    agent, noise = config["agent"], inputs["select_noise"]
    states = repeated(inputs["select_observations"], noise)
    candidates, _ = fast_chain(state["actor"], states, noise, agent["actor"]["activation"])
    q = fast_values(state["target_critic"], states, candidates, agent["critic"]["activation"]).min(0)
    exponentials = np.exp((q - q.max(-1, keepdims=True)) / agent["temperature"])
    probabilities = exponentials / exponentials.sum(-1, keepdims=True)
    return {"select.candidates": candidates, "select.q": q, "select.probabilities": probabilities}


# Random states and inputs.


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    state = {
        "actor": random_predictor(rng, o, a, agent["actor"]),
        "critic": random_network(rng, o + a, agent["critic"], 1, CRITICS),
    }
    for name in "actor", "critic":
        state[f"target_{name}"] = near(rng, state[name])
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng, size):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    steps, b, n = agent["diffusion_steps"], config["batch_size"], SIZES[size]["select"]
    return random_batch(rng, config) | {
        "next_noise": single(rng.normal(size=(steps, b, agent["samples"], a))),
        "policy_noise": single(rng.normal(size=(steps, b, a))),
        "first_critic": rng.integers(2, size=1),
        "t": rng.permutation(np.arange(b) % steps + 1),
        "epsilon": single(rng.normal(size=(b, a))),
        "select_observations": single(rng.normal(size=(n, o))),
        "select_noise": single(rng.normal(size=(steps, n, agent["candidates"], a))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where an x0 of the policy's chain is so close to ±1 that rounding could
    turn its gradient on or off.
    """
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    activation = config["agent"]["actor"]["activation"]
    _, x0 = fast_chain(state["actor"], inputs["observations"], inputs["policy_noise"], activation)
    room = 1e-4 if size != "hopper" else 0
    if np.any(abs(abs(x0) - 1) < room) or not 0.1 < np.mean(abs(x0) < 1) < 0.9:
        return None
    return state, inputs, update(config, state, inputs)[0] | act(config, state, inputs)
