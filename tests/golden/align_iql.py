"""One update of AlignIQL (He et al. 2024), without its multipliers, and of IDQL, which differs in the choice of an action."""

import math

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from diffusion import predict_noise, random_predictor, repeated, schedule
from implicit import RATES, SIZES, fast_value, least, random_values, update_critics
from iql import update_value
from networks import adam_step, compiled, decayed, follow, near, random_moments, shape, single, values

AGENT = {
    "diffusion_steps": 5,
    "gamma": 0.99,
    "expectile": 0.7,
    "weight_decay": 0.5,
    "actor_ema_rate": 0.02,
    "candidates": 10,
}
HIDDEN = {"narrow": 5, "small": 7, "hopper": 256}  # the actor's
FOLDERS = {"align-iql": (20, "small"), "idql": (53, "small"), "idql-online": (66, "small")}


def make_config(variant, size):
    networks = implicit.value_networks(size) | {"actor": shape([HIDDEN[size]] * 3, "silu")}
    online = {"step": 2300, "online_steps": 1000} if variant == "idql-online" else {}
    return implicit.make_config(variant.removesuffix("-online"), size, networks | AGENT | RATES) | online


@compiled
def sample(actor, states, noise, activation):
    """Actions for states [..., o] with noise [T, ..., a]: the plain mean of DDPM, the actions clipped at each step."""
    steps = len(noise)
    beta, alpha_bar = schedule(steps)
    x = noise[0]
    for t in range(steps, 0, -1):
        epsilon = predict_noise(actor, states, x, jnp.full(states.shape[:-1], t), activation)
        x = (x - beta[t] / math.sqrt(1 - alpha_bar[t]) * epsilon) / math.sqrt(1 - beta[t])
        if t > 1:
            x = x + math.sqrt(beta[t]) * noise[steps - t + 1]
        x = jnp.clip(x, -1, 1)
    return x


# Losses and their gradients; V's is IQL's.


def bc_loss(actor, states, noisy, t, epsilon, activation):
    """Summed over the action's dimensions."""
    return jnp.mean(jnp.sum((epsilon - predict_noise(actor, states, noisy, t, activation)) ** 2, -1))


def critic_loss(critics, states, actions, targets, activation):
    return jnp.mean((values(critics, states, actions, activation) - targets) ** 2)


bc_gradient = compiled(jax.value_and_grad(bc_loss))
critic_gradient = compiled(jax.value_and_grad(critic_loss))


# One update.


def update(config, state, inputs):
    """All that must come out; and q."""
    agent, step = config["agent"], config["step"]
    _, alpha_bar = schedule(agent["diffusion_steps"])
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))

    # The actor, which only clones; online it stays where it is, and its average follows.
    noisy = np.sqrt(alpha_bar[t])[:, None] * a + np.sqrt(1 - alpha_bar[t])[:, None] * epsilon
    loss, gradients = bc_gradient(state["actor"], s, noisy, t, epsilon, agent["actor"]["activation"])
    rate = decayed(agent["actor_learning_rate"], config, online=0.0)
    out = {"noisy_actions": noisy, "bc_loss": loss}
    out |= adam_step(state, "actor", gradients, rate, step, agent["weight_decay"])
    out["target_actor"] = follow(state["target_actor"], out["actor"], agent["actor_ema_rate"])

    # V, and the critics with the V that has just moved.
    q = least(state["target_critic"], s, a, config)
    out |= update_value(config, state, inputs, q)
    v = fast_value(out["value"], s, agent["value"]["activation"])
    out |= {"v_mean": v.mean(), "advantage_mean": (q - v).mean()}
    return out | update_critics(config, state, inputs, out["value"], critic_gradient), q


def act(config, state, inputs):
    """The candidate of the target actor whose value is closest to V, IDQL's whose is largest, with the networks as they are
    before the update.
    """
    agent, noise, observations = config["agent"], inputs["select_noise"], inputs["select_observations"]
    states = repeated(observations, noise)
    candidates = sample(state["target_actor"], states, noise, agent["actor"]["activation"])
    q = least(state["target_critic"], states, candidates, config)
    v = fast_value(state["value"], observations, agent["value"]["activation"])
    distance = -q if config["algorithm"] == "idql" else abs(q - v[:, None])
    index = distance.argmin(-1)
    out = {"select.candidates": candidates, "select.q": q, "select.v": v, "select.index": index}
    return out | {"select.actions": candidates[np.arange(len(index)), index]}


# Random states and inputs.


def random_state(config, rng, size):
    o, a, spread = config["observation_dim"], config["action_dim"], SIZES[size]["spread"]
    state = {"actor": random_predictor(rng, o, a, config["agent"]["actor"])} | random_values(config, rng, spread)
    for name in "actor", "critic", "value":
        if name != "value":
            state[f"target_{name}"] = near(rng, state[name])
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng, size, state):
    agent, a = config["agent"], config["action_dim"]
    steps, b, n = agent["diffusion_steps"], config["batch_size"], SIZES[size]["select"]
    inputs = implicit.random_inputs(config, rng, size) | {
        "t": rng.permutation(np.arange(b) % steps + 1),
        "epsilon": single(rng.normal(size=(b, a))),
    }
    # A choice between candidates nearly alike would depend on rounding: draw such states' noise again.
    noise = np.zeros((steps, n, agent["candidates"], a))
    close = np.full(n, True)
    while close.any():
        noise[:, close] = single(rng.normal(size=noise[:, close].shape))
        came = act(config, state, inputs | {"select_noise": noise})
        best = config["algorithm"] == "idql"
        distances = np.sort(-came["select.q"] if best else abs(came["select.q"] - came["select.v"][:, None]))
        close = distances[:, 1] - distances[:, 0] < 1e-3
    return inputs | {"select_noise": noise}


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where they do not show both sides of the expectile, or where the choice
    is always that of the least or always that of the largest value.
    """
    state = random_state(config, rng, size)
    inputs = random_inputs(config, rng, size, state)
    expected, q = update(config, state, inputs)
    expected |= act(config, state, inputs)
    v = fast_value(state["value"], inputs["observations"], config["agent"]["value"]["activation"])
    chosen = expected["select.index"]
    extremes = [np.mean(chosen == worst) for worst in (expected["select.q"].argmin(-1), expected["select.q"].argmax(-1))]
    if not 0.1 < np.mean(q > v) < 0.9 or (variant == "align-iql" and max(extremes) > 0.5):
        return None
    return state, inputs, expected
