"""One update of RLPD (Ball et al. 2023), in the order of its authors' code: critics and their targets, and in the last of
`actor_every` steps the policy, by the critics as they are then, and α. And one of SAC, by the same functions with other
values; stable-baselines3's SAC moves α first, but uses it as it was.
"""

import jax
import jax.numpy as jnp
import numpy as np

from cql import squashed_density
from implicit import SIZES
from networks import adam_step, compiled, configuration, ensemble, fast_values, follow, near, random_batch, random_moments
from networks import random_network, shape, single, values

FOLDERS = {"rlpd": (60, "small"), "rlpd-critics": (61, "small"), "sac": (62, "small")}
LOG_STD = -20.0, 2.0
AGENT = {"gamma": 0.99, "temperature": 0.5, "learning_rate": 0.02, "decay": False, "ema_rate": 0.05}
RLPD = {"critics": 4, "actor_q": "mean", "target_entropy": -0.5, "temperature_loss": "alpha"}
SAC = {"critics": 2, "actor_q": "min", "target_entropy": -1.0, "temperature_loss": "log"}
# The policy's step, and one of the critics alone.
VARIANTS = {
    "rlpd": (701, RLPD | {"target_critics": 2, "entropy_backup": True, "actor_every": 2}),
    "rlpd-critics": (700, RLPD | {"target_critics": 1, "entropy_backup": False, "actor_every": 3}),
    "sac": (700, SAC | {"target_critics": 2, "entropy_backup": True, "actor_every": 1}),
}


def make_config(variant, size):
    (step, own), hidden = VARIANTS[variant], SIZES[size]["hidden"]
    activation = "mish" if size == "hopper" else "relu"
    algorithm = variant.partition("-")[0]
    networks = {"actor": shape([hidden, hidden], activation), "critic": shape([hidden, hidden - 1], activation, algorithm == "rlpd")}
    return configuration(algorithm, SIZES[size]["batch_size"], step, networks | AGENT | own)


def sampled(actor, states, noise, activation):
    """Actions tanh(u) with noise [B, a], and ln π of each, [B]."""
    mean, log_std = jnp.split(ensemble(actor, states, activation)[0], 2, -1)
    log_std = jnp.clip(log_std, *LOG_STD)
    u = mean + jnp.exp(log_std) * noise
    return jnp.tanh(u), squashed_density(u, mean, log_std)


def critic_loss(critics, states, actions, targets, activation):
    return jnp.mean((values(critics, states, actions, activation) - targets) ** 2)


def actor_loss(actor, critics, states, noise, alpha, is_mean, activation, critic_activation):
    actions, density = sampled(actor, states, noise, activation)
    q = values(critics, states, actions, critic_activation)
    return jnp.mean(alpha * density - jnp.where(is_mean, q.mean(0), q.min(0))), density.mean()


fast_sampled, fast_mean = compiled(sampled), compiled(ensemble)
critic_gradient = compiled(jax.value_and_grad(critic_loss))
actor_gradient = compiled(jax.value_and_grad(actor_loss, has_aux=True))


def update(config, state, inputs):
    """All that must come out."""
    agent, step, rate = config["agent"], config["step"], config["agent"]["learning_rate"]
    activation, critic_activation = agent["actor"]["activation"], agent["critic"]["activation"]
    s, following, log_alpha = inputs["observations"], inputs["next_observations"], state["log_alpha"]["value"]
    alpha = np.exp(log_alpha[0])

    actions, density = fast_sampled(state["actor"], following, inputs["next_noise"], activation)
    q = fast_values(state["target_critic"], following, actions, critic_activation)[inputs["target_critics"]].min(0)
    q = q - alpha * density if agent["entropy_backup"] else q
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * q
    out = dict(state) | {"targets": targets, "target_q_mean": targets.mean(), "actor_loss": 0.0, "entropy": 0.0, "alpha": 0.0}
    out["critic_loss"], gradients = critic_gradient(state["critic"], s, inputs["actions"], targets, critic_activation)
    out |= adam_step(state, "critic", gradients, rate, step)
    out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])

    if step % agent["actor_every"] == agent["actor_every"] - 1:
        is_mean = agent["actor_q"] == "mean"
        given = out["critic"], s, inputs["policy_noise"], alpha, is_mean, activation, critic_activation
        (out["actor_loss"], density), gradients = actor_gradient(state["actor"], *given)
        out |= {"entropy": -density, "alpha": alpha}
        out |= adam_step(state, "actor", gradients, rate, step // agent["actor_every"])
        excess = -density - agent["target_entropy"] * config["action_dim"]
        slope = excess * (alpha if agent["temperature_loss"] == "alpha" else 1)
        out |= adam_step(state, "log_alpha", {"value": slope * np.ones(1)}, rate, step // agent["actor_every"])
    return out, None


def act(config, state, inputs):
    """The tanh of the mean, before the update."""
    out = fast_mean(state["actor"], inputs["select_observations"], config["agent"]["actor"]["activation"])[0]
    return {"select.actions": np.tanh(out[:, : config["action_dim"]])}


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    state = {
        "actor": random_network(rng, o, agent["actor"], 2 * a, 1),
        "critic": random_network(rng, o + a, agent["critic"], 1, agent["critics"]),
        "log_alpha": {"value": single(rng.uniform(-1, 0, 1))},
    }
    for name in list(state):
        state |= random_moments(rng, name, state[name])
    return state | {"target_critic": near(rng, state["critic"])}


def random_inputs(config, rng, size):
    agent, b, a = config["agent"], config["batch_size"], config["action_dim"]
    inputs = random_batch(rng, config) | {name: single(rng.normal(size=(b, a))) for name in ("next_noise", "policy_noise")}
    inputs["target_critics"] = rng.permutation(agent["critics"])[: agent["target_critics"]]
    return inputs | {"select_observations": single(rng.normal(size=(SIZES[size]["select"], config["observation_dim"])))}


def draw(config, variant, size, rng):
    """A state, inputs and what comes out."""
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    return state, inputs, update(config, state, inputs)[0] | act(config, state, inputs)
