"""One update of Diffusion Trusted Q-Learning (Chen, Wang and Zhou 2024), in pre-training and after it."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from implicit import log_density
from networks import (
    adam_step,
    compiled,
    configuration,
    ensemble,
    follow,
    mlp,
    near,
    random_batch,
    random_moments,
    random_network,
    shape,
    single,
    values,
)

CRITICS = 2
SIGMA_DATA = 0.5
TIME_FEATURES, TIME_HIDDEN, TIME_EMBEDDING = 16, 32, 16
LOG_STD = -5.0, 2.0
# Number that PyTorch's layer norm adds to the variance.
TORCH_EPSILON = 1e-5
# Large rates, so that a mistake in an optimizer or an average is far larger than float32's rounding.
AGENT = {
    "gamma": 0.99,
    "expectile": 0.7,
    "alpha": 1.5,
    "learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "ema_rate": 0.05,
    "candidates": 12,
    "temperature": 0.1,
    "phases": {"pretraining": 1, "policy": 3},
}
SIZES = {
    "narrow": {"hidden": 5, "batch_size": 23, "select": 3},
    "small": {"hidden": 7, "batch_size": 24, "select": 6},
    "hopper": {"hidden": 256, "batch_size": 256, "select": 32},
}
# The step, of 2,000 of which 500 are pre-training, and what is switched on.
FOLDERS = {"dtql-pretraining": (27, "small"), "dtql": (28, "small"), "dtql-likelihood": (29, "small")}
VARIANTS = {
    "dtql-pretraining": (300, {"likelihood": 0.5, "cosine": True}),
    "dtql": (700, {"likelihood": 0.0, "cosine": False}),
    "dtql-likelihood": (1400, {"likelihood": 0.5, "cosine": True}),
}


def make_config(variant, size):
    hidden, wide = [SIZES[size]["hidden"]] * 3, size == "hopper"
    step, switches = VARIANTS[variant]
    # In wide networks some ReLU is always about to turn: those have Mish.
    networks = {
        "actor": shape(hidden, "mish" if wide else "relu"),
        "diffusion": shape(hidden),
        "critic": shape(hidden, "mish", True) | {"norm_epsilon": "torch"},
        "value": shape(hidden),
    }
    return configuration("dtql", SIZES[size]["batch_size"], step, networks | AGENT | switches)


# Networks. V and the actor are ensembles of one.


def q_values(critics, states, actions, activation):
    """Q_k(s, a) of the whole ensemble, [K, ...]."""
    return values(critics, states, actions, activation, TORCH_EPSILON)


def gaussian(actor, states, activation):
    """Mean and ln σ, [..., a] each, of the normal numbers whose tanh is the action."""
    mean, log_std = jnp.split(ensemble(actor, states, activation)[0], 2, -1)
    return mean, jnp.clip(log_std, *LOG_STD)


def one_step(actor, states, noise, activation):
    mean, log_std = gaussian(actor, states, activation)
    return jnp.tanh(mean + jnp.exp(log_std) * noise)


def output_scale(sigma):
    return sigma * SIGMA_DATA / jnp.sqrt(sigma**2 + SIGMA_DATA**2)


def denoise(denoiser, states, noisy, sigma, activation):
    """The clean actions that are seen in noisy ones [B, a], before they are clipped; sigma is [B]."""
    angles = jnp.log(sigma)[:, None] / 4 * jnp.exp(-jnp.arange(8) * math.log(10_000) / 7)
    embedding = mlp(denoiser, "time.", "mish", jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], -1))
    sigma = sigma[:, None]
    variance = sigma**2 + SIGMA_DATA**2
    x = jnp.concatenate([states, noisy / jnp.sqrt(variance), embedding], -1)
    x = x @ denoiser["input.0.kernel"] + denoiser["input.0.bias"]
    out = mlp(denoiser, "trunk.", activation, x)
    return output_scale(sigma) * out + SIGMA_DATA**2 / variance * noisy


# Losses and their gradients.


def denoising_loss(denoiser, states, actions, sigma, noise, activation):
    """EDM's loss with clipped outputs; also what they are before that."""
    clean = denoise(denoiser, states, actions + sigma[:, None] * noise, sigma, activation)
    error = (jnp.clip(clean, -1, 1) - actions) / output_scale(sigma[:, None])
    return jnp.mean(error**2), clean


def value_loss(network, states, q, expectile, activation):
    difference = q - ensemble(network, states, activation)[0, :, 0]
    return jnp.mean(jnp.where(difference > 0, expectile, 1 - expectile) * difference**2)


def critic_loss(critics, states, actions, targets, activation):
    return jnp.sum(jnp.mean((q_values(critics, states, actions, activation) - targets) ** 2, -1))


def actor_loss(actor, denoiser, critics, batch, strengths, activation, diffusion_activation, critic_activation):
    """The trust region, Q and the data's likelihood; also these, the actions, and what they are denoised to."""
    states, data, policy_noise, sigma, noise = batch
    alpha, likelihood = strengths
    actions = one_step(actor, states, policy_noise, activation)
    trust, clean = denoising_loss(denoiser, states, actions, sigma, noise, diffusion_activation)
    q = -q_values(critics, states, actions, critic_activation).min(0).mean()
    surprise = -log_density(jnp.arctanh(data / 1.001), *gaussian(actor, states, activation)).mean()
    return alpha * trust + q + likelihood * surprise, (trust, q, surprise, actions, clean)


denoiser_gradient = compiled(jax.value_and_grad(denoising_loss, has_aux=True))
value_gradient = compiled(jax.value_and_grad(value_loss))
critic_gradient = compiled(jax.value_and_grad(critic_loss))
actor_gradient = compiled(jax.value_and_grad(actor_loss, has_aux=True))
fast_values, fast_actions = compiled(q_values), compiled(one_step)
fast_value = compiled(lambda network, states, activation: ensemble(network, states, activation)[0, :, 0])


# One update.


def update(config, state, inputs):
    """All that must come out; and what actions are denoised to before they are clipped."""
    agent, step = config["agent"], config["step"]
    s, a = inputs["observations"], inputs["actions"]
    activations = {name: agent[name]["activation"] for name in ("actor", "diffusion", "critic", "value")}
    shares = agent["phases"]
    begin = config["total_steps"] * shares["pretraining"] // sum(shares.values())
    decay = 1.0
    if agent["cosine"] and step >= begin:
        decay = 0.5 * (1 + math.cos(math.pi * (step - begin) / (config["total_steps"] - begin)))
    rate, critic_rate = agent["learning_rate"] * decay, agent["critic_learning_rate"] * decay

    # V and the critics, each with the other as it was.
    v, next_v = (fast_value(state["value"], inputs[x], activations["value"]) for x in ("observations", "next_observations"))
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * next_v
    q = fast_values(state["critic"], s, a, activations["critic"]).min(0)
    out = dict(state) | {"targets": targets, "target_q_mean": targets.mean(), "v_mean": v.mean()}
    out["value_loss"], gradients = value_gradient(state["value"], s, q, agent["expectile"], activations["value"])
    out |= adam_step(state, "value", gradients, critic_rate, step)
    out["critic_loss"], gradients = critic_gradient(state["critic"], s, a, targets, activations["critic"])
    out |= adam_step(state, "critic", gradients, critic_rate, step)

    # The diffusion policy.
    batch = s, a, inputs["bc_sigma"], inputs["bc_noise"]
    (out["bc_loss"], clean), gradients = denoiser_gradient(state["diffusion"], *batch, activations["diffusion"])
    out |= adam_step(state, "diffusion", gradients, rate, step)
    out |= dict.fromkeys(("trust_loss", "q_loss", "likelihood_loss", "actor_loss"), 0.0)
    if step < begin:
        return out, clean

    # The one-step policy, with critics and diffusion policy that have just moved.
    batch = s, a, inputs["policy_noise"], inputs["trust_sigma"], inputs["trust_noise"]
    arguments = out["diffusion"], out["critic"], batch, (agent["alpha"], agent["likelihood"])
    order = activations["actor"], activations["diffusion"], activations["critic"]
    (loss, (trust, q, surprise, actions, of_policy)), gradients = actor_gradient(state["actor"], *arguments, *order)
    out |= adam_step(state, "actor", gradients, rate, step - begin)
    out |= {"trust_loss": trust, "q_loss": q, "actor_loss": loss, "policy_actions": actions}
    out["likelihood_loss"] = surprise if agent["likelihood"] else 0.0
    out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])
    return out, np.concatenate([clean, of_policy])


def act(config, state, inputs):
    """The values of the one-step policy's candidates, and the probability that each is drawn, before the update."""
    agent, noise = config["agent"], inputs["select_noise"][0]
    states = np.broadcast_to(inputs["select_observations"][:, None], noise.shape[:-1] + (config["observation_dim"],))
    candidates = fast_actions(state["actor"], states, noise, agent["actor"]["activation"])
    q = fast_values(state["target_critic"], states, candidates, agent["critic"]["activation"]).min(0)
    exponentials = np.exp((q - q.max(-1, keepdims=True)) / agent["temperature"])
    probabilities = exponentials / exponentials.sum(-1, keepdims=True)
    return {"select.candidates": candidates, "select.q": q, "select.probabilities": probabilities}


# Random states and inputs.


def random_denoiser(rng, o, a, trunk):
    width = trunk["hidden"][0]
    return (
        random_network(rng, TIME_FEATURES, shape([TIME_HIDDEN]), TIME_EMBEDDING, prefix="time.")
        | random_network(rng, o + a + TIME_EMBEDDING, shape([]), width, prefix="input.")
        | random_network(rng, width, trunk, a, prefix="trunk.")
    )


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    state = {
        "actor": random_network(rng, o, agent["actor"], 2 * a, 1),
        "diffusion": random_denoiser(rng, o, a, agent["diffusion"]),
        "critic": random_network(rng, o + a, agent["critic"], 1, CRITICS),
        "value": random_network(rng, o, agent["value"], 1, 1),
    }
    for name in list(state):
        state |= random_moments(rng, name, state[name])
    return state | {"target_critic": near(rng, state["critic"])}


def random_inputs(config, rng, size):
    b, n = config["batch_size"], SIZES[size]["select"]
    o, a = config["observation_dim"], config["action_dim"]
    p = rng.uniform(0.02, 0.98, (2, b))
    sigma = single(SIGMA_DATA * np.sqrt(p / (1 - p)))
    noises = {name: single(rng.normal(size=(b, a))) for name in ("bc_noise", "policy_noise", "trust_noise")}
    return random_batch(rng, config) | noises | {
        "bc_sigma": sigma[0],
        "trust_sigma": sigma[1],
        "select_observations": single(rng.normal(size=(n, o))),
        "select_noise": single(rng.normal(size=(1, n, config["agent"]["candidates"], a))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where what actions are denoised to is so close to ±1 that rounding could
    turn a gradient on or off, or is never beyond it.
    """
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    expected, clean = update(config, state, inputs)
    room = 1e-4 if size != "hopper" else 0
    if np.any(abs(abs(clean) - 1) < room) or not np.any(abs(clean) > 1):
        return None
    return state, inputs, expected | act(config, state, inputs)
