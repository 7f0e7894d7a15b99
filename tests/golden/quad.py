"""One update of QUAD. Equation numbers are its paper's; where that is silent, the rules are DAC's (docs/deviations.md)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import guidance
from diffusion import clean, denoise, fast_noise, predict_noise, random_predictor, sample, schedule
from networks import (
    adam_step,
    clip_by_norm,
    compiled,
    configuration,
    decayed,
    fast_values,
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

# Large rates, so that a mistake in an optimizer or an average is far larger than float32's rounding.
AGENT = {
    "diffusion_steps": 5,
    "gamma": 0.99,
    "rho": 1.5,
    "guidance": "quad",
    "tau": 0.5,
    "delta": 6e-3,
    "target_reduce": "mean",
    "eta": {"initial": 1.0, "threshold": 0.7, "rate": 0.05, "minimum": 1e-3, "maximum": 100.0},
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "online_rate": 0.4,
    "gradient_clip": 0.5,
    "ema_rate": 0.05,
    "nu_ema_rate": 0.1,
    "actor_ema_every": 5,
    "actor_ema_start": 1000,
    "candidates": 10,
}
# Small and odd, so that no row is a whole number of vector registers.
SIZES = {
    "narrow": {"hidden": 5, "critics": 2, "samples": 2, "batch_size": 7, "select": 3},
    "small": {"hidden": 11, "critics": 3, "samples": 2, "batch_size": 8, "select": 6},
    "hopper": {"hidden": 256, "critics": 10, "samples": 10, "batch_size": 256, "select": 32},
}


class Variant(NamedTuple):
    step: int  # early, where Adam's bias correction is large, or late, where the learning rate has decayed
    agent: dict  # where it differs from AGENT


FOLDERS = {
    "quad": (1, "small"),
    "dac": (2, "small"),
    "maxq": (3, "small"),
    "none": (4, "narrow"),
    "one-sample": (5, "narrow"),
    "ten-critics": (6, "narrow"),
    "constant": (24, "small"),
    "mean": (25, "small"),
    "shuffled": (26, "small"),
    "quad-online": (63, "small"),
    "denoised": (64, "small"),
    "denoised-dac": (65, "small"),
}
VARIANTS = {
    "quad": Variant(1235, {}),
    "dac": Variant(1000, {"guidance": "dac", "gradient_clip": 100.0}),
    "maxq": Variant(
        4,
        {"target_reduce": "max", "samples": 3, "rho": 1.0, "tau": 10.0, "delta": 2e-3, "actor_ema_start": 3}
        | {"eta": {"initial": 0.1, "rate": 0.05, "minimum": 1e-3, "maximum": 100.0}},
    ),
    "none": Variant(0, {"guidance": "none", "actor_ema_start": 0}),
    "one-sample": Variant(1005, {"samples": 1}),
    "ten-critics": Variant(1234, {"critics": 10, "samples": 4}),
    "constant": Variant(1236, {"guidance": "constant", "lambda": 0.3}),
    "mean": Variant(1237, {"guidance": "mean", "diffusion_steps": 7}),
    "shuffled": Variant(1238, {"guidance": "shuffled", "diffusion_steps": 3}),
    "quad-online": Variant(2300, {}),
    "denoised": Variant(1239, {"guidance_at": "denoised"}),
    "denoised-dac": Variant(1240, {"guidance": "dac", "guidance_at": "denoised"}),
}


def make_config(variant, size):
    sizes = SIZES[size].copy()
    batch_size = sizes.pop("batch_size")
    sizes.pop("select")
    hidden = [sizes.pop("hidden")] * 3
    agent = {"actor": shape(hidden), "critic": shape(hidden)} | AGENT | sizes | VARIANTS[variant].agent
    return configuration("quad", batch_size, VARIANTS[variant].step, agent)


# Losses and their gradients.


def critic_loss(critics, states, actions, targets, activation):
    return jnp.mean((values(critics, states, actions, activation) - targets) ** 2)


def actor_loss(actor, states, noisy_actions, t, epsilon, eta, weight, gradient, activation):
    """Eq. 19, given weight λ·w(t) [B, 1] and the normalized gradient ḡ [B, a]; also its two terms."""
    predicted = predict_noise(actor, states, noisy_actions, t, activation)
    bc = jnp.mean((epsilon - predicted) ** 2)
    pull = jnp.mean(weight * predicted * gradient)
    return eta * bc + pull, (bc, pull)


@compiled
def action_gradients(critics, states, actions, activation):
    """∂Q_k/∂a for each critic and row, [K, B, a]; rows do not depend on one another, so their sum will do."""

    def total(critic, actions):
        return mlp(critic, "", activation, jnp.concatenate([states, actions], -1)).sum()

    return jax.vmap(jax.grad(total, 1), (0, None))(critics, actions)


critic_gradient = compiled(jax.value_and_grad(critic_loss))
actor_gradient = compiled(jax.value_and_grad(actor_loss, has_aux=True))


# One update.


def target_values(config, state, inputs):
    """Next actions [B, S, a] and the bootstrapped targets y [B], Eq. 20."""
    agent = config["agent"]
    activation = agent["actor"]["activation"]
    next_actions, next_states = sample(
        state["target_actor"], inputs["next_observations"], inputs["next_noise"], activation
    )
    q = fast_values(state["target_critic"], next_states, next_actions, agent["critic"]["activation"])  # [K, B, S]
    q = q.max(-1) if agent["target_reduce"] == "max" else q.mean(-1)  # each critic's own, [K, B]
    lcb = q.mean(0) - agent["rho"] * q.std(0)
    return next_actions, inputs["rewards"] + agent["gamma"] * inputs["masks"] * lcb


def guide(config, state, inputs, noisy, target_critic):
    """Eq. 10 and 21-24: λ [B], ḡ [B, a], the tensors to compare, and δ's share of each row's denominator [B]."""
    agent, s, a = config["agent"], inputs["observations"], inputs["actions"]
    if agent["guidance"] == "none":
        nothing = {"nu_squared": state["nu_squared"], "lambda_mean": 0.0, "delta_share": 0.0}
        return np.zeros(len(s)), np.zeros_like(a), nothing, np.zeros(len(s))
    activation = agent["critic"]["activation"]
    predicted = fast_noise(state["actor"], s, noisy, inputs["t"], agent["actor"]["activation"])
    at = noisy
    if agent.get("guidance_at") == "denoised":  # QGF, with the identity as x0's Jacobian
        at = clean(noisy, predicted, schedule(agent["diffusion_steps"])[1][inputs["t"], None])
    gradients = action_gradients(target_critic, s, at, activation)
    q_scale = np.abs(fast_values(target_critic, s, a, activation)).mean() + 1e-6
    g = gradients / q_scale
    u = predicted / (np.linalg.norm(predicted, axis=-1, keepdims=True) + 1e-8)
    alignment = (u * g).sum(-1)  # [K, B]
    sigma_squared = alignment.var(0)
    nu_squared, batch_nu, rate = state["nu_squared"][0], alignment.mean(0).var(), agent["nu_ema_rate"]
    nu_squared = np.where(nu_squared < 0, batch_nu, (1 - rate) * nu_squared + rate * batch_nu)
    weights, share_of_delta, means = guidance.weigh(agent, state, inputs, nu_squared, sigma_squared)
    out = {"critic_action_gradients": gradients, "q_scale": q_scale, "u": u, "sigma_squared": sigma_squared}
    out |= {"nu_squared": nu_squared, "lambda": weights, "delta_share": np.mean(share_of_delta > 0.01)} | means
    rows = inputs["t"], weights, nu_squared, sigma_squared, g.mean(0), predicted - inputs["epsilon"]
    return weights, g.mean(0), out | guidance.measure(agent, *rows), share_of_delta


def update(config, state, inputs):
    """All that must come out; and, for `draw`, how each row's δ and η's step came out."""
    agent, step = config["agent"], config["step"]
    beta, alpha_bar = schedule(agent["diffusion_steps"])
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))
    out = {"schedule.beta": beta[1:], "schedule.alpha_bar": alpha_bar[1:]}

    next_actions, targets = target_values(config, state, inputs)
    out |= {"next_actions": next_actions, "targets": targets, "target_q_mean": targets.mean()}

    # Critics, and their targets.
    loss, gradients = critic_gradient(state["critic"], s, a, targets, agent["critic"]["activation"])
    gradients, norm = clip_by_norm(gradients, agent["gradient_clip"])
    out |= adam_step(state, "critic", gradients, decayed(agent["critic_learning_rate"], config, agent["online_rate"]), step)
    out |= {"critic_loss": loss, "critic_gradient_norm": norm}
    out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])

    # Noisy actions, Eq. 5, and their guidance by the critics' new targets.
    noise_level = np.sqrt(1 - alpha_bar[t])[:, None]  # also w(t)
    out["noisy_actions"] = noisy = np.sqrt(alpha_bar[t])[:, None] * a + noise_level * epsilon
    weights, mean_gradient, more, share_of_delta = guide(config, state, inputs, noisy, out["target_critic"])
    out |= more

    # Actor, Eq. 19.
    arguments = (s, noisy, t, epsilon, state["eta"][0], weights[:, None] * noise_level, mean_gradient)
    arguments += (agent["actor"]["activation"],)
    (loss, (bc, pull)), gradients = actor_gradient(state["actor"], *arguments)
    gradients, norm = clip_by_norm(gradients, agent["gradient_clip"])
    out |= adam_step(state, "actor", gradients, decayed(agent["actor_learning_rate"], config, agent["online_rate"]), step)
    out |= {"actor_loss": loss, "bc_loss": bc, "guidance_loss": pull, "actor_gradient_norm": norm}

    # Dual ascent on η, with the actor that has just moved.
    (_, (bc, _)), _ = actor_gradient(out["actor"], *arguments)
    eta, difference = state["eta"][0], 0.0
    if agent["guidance"] != "none" and "threshold" in agent["eta"]:
        difference = bc - agent["eta"]["threshold"]
        eta = eta + agent["eta"]["rate"] * np.clip(difference, -1, 1)
    out["eta"] = np.clip(eta, agent["eta"]["minimum"], agent["eta"]["maximum"])

    # The target actor: the count is tested before this update raises it.
    follows = step % agent["actor_ema_every"] == 0 and step > agent["actor_ema_start"]
    target = state["target_actor"]
    out["target_actor"] = follow(target, out["actor"], agent["ema_rate"]) if follows else target
    return out, {"share_of_delta": share_of_delta, "difference": difference, "unbounded_eta": eta}


def act(config, state, inputs):
    """Eq. 25, and single reverse steps, with the target networks as they are before the update."""
    noise, actor = inputs["select_noise"], state["target_actor"]
    actors, critics = (config["agent"][name]["activation"] for name in ("actor", "critic"))
    candidates, states = sample(actor, inputs["select_observations"], noise, actors)
    q = fast_values(state["target_critic"], states, candidates, critics).mean(0)
    index = q.argmax(-1)
    steps = len(noise)
    reverse = [
        denoise(actor, inputs["observations"], inputs["denoise_actions"][t - 1], t, steps, actors)
        for t in range(1, steps + 1)
    ]
    out = {}
    if "select_guidance" in inputs:

        def pull(states, x0):
            return inputs["select_guidance"] * action_gradients(state["target_critic"], states, x0, critics).mean(0)

        out["select.guided"] = sample(actor, inputs["select_observations"], noise, actors, pull)[0]
    return out | {
        "denoise.x0": np.stack([x0 for x0, _ in reverse]),
        "denoise.mean": np.stack([mean for _, mean in reverse]),
        "select.q": q,
        "select.index": index,
        "select.actions": candidates[np.arange(len(states)), index],
    }


# Random states and inputs.


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    state = {
        "actor": random_predictor(rng, o, a, agent["actor"]),
        "critic": random_network(rng, o + a, agent["critic"], 1, agent["critics"]),
    }
    for name in "actor", "critic":
        state[f"target_{name}"] = near(rng, state[name])
        state |= random_moments(rng, name, state[name])
    state["eta"] = single([agent["eta"]["initial"]])
    state["nu_squared"] = single([-1.0 if agent["target_reduce"] == "max" else 0.5])
    return state | guidance.random_state(agent, rng)


def random_inputs(config, rng, size, state):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    steps, b, n = agent["diffusion_steps"], config["batch_size"], SIZES[size]["select"]
    inputs = random_batch(rng, config) | {
        "next_noise": single(rng.normal(size=(steps, b, agent["samples"], a))),
        "t": rng.permutation(np.arange(b) % steps + 1),
        "epsilon": single(rng.normal(size=(b, a))),
        "denoise_actions": single(rng.normal(size=(steps, b, a))),
        "select_observations": single(rng.normal(size=(n, o))),
    }
    inputs |= guidance.random_inputs(agent, inputs["t"], rng)
    if "guidance_at" in agent:
        inputs["select_guidance"] = single([0.7])
    # A choice between candidates of nearly equal value would depend on rounding: draw such states' noise again.
    noise = np.zeros((steps, n, agent["candidates"], a))
    close = np.full(n, True)
    while close.any():
        noise[:, close] = single(rng.normal(size=noise[:, close].shape))
        q = np.sort(act(config, state, inputs | {"select_noise": noise})["select.q"])
        close = q[:, -1] - q[:, -2] < 1e-3
    return inputs | {"select_noise": noise}


def eta_is_free(config, came):
    """True if η stays, or moves well within its bounds and by a step well below the largest."""
    agent, eta = config["agent"], came["unbounded_eta"]
    if agent["guidance"] == "none" or "threshold" not in agent["eta"]:
        return True
    bounds = agent["eta"]["minimum"] + 0.01, agent["eta"]["maximum"] - 0.01
    return bounds[0] <= eta <= bounds[1] and abs(came["difference"]) <= 0.95


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where rounding could decide."""
    state = random_state(config, rng)
    inputs = random_inputs(config, rng, size, state)
    expected, came = update(config, state, inputs)
    # δ's share of a row must not be so close to a hundredth that rounding could take it to the other side.
    while np.any(abs(came["share_of_delta"] / 0.01 - 1) < 2e-3):
        if state["nu_squared"][0] < 0:
            return None
        state["nu_squared"] = single([rng.uniform(0.3, 0.7)])
        expected, came = update(config, state, inputs)
    if not eta_is_free(config, came):
        return None
    return state, inputs, expected | act(config, state, inputs)
