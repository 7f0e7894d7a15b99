"""Shared by IQL and its kin: V(s) from the target critics' smaller value, a Gaussian policy cloned from the data with
weights, and twin critics toward r + γ·V(s'). V and the actor are ensembles of one.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from networks import (
    adam_step,
    compiled,
    configuration,
    decayed,
    ensemble,
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
LARGEST_WEIGHT = 100.0
LOG_STD = -5.0, 2.0

# Large rates, so that a mistake in an optimizer or an average is far larger than float32's rounding.
RATES = {
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "value_learning_rate": 0.004,
    "ema_rate": 0.05,
}
# The spread widens the values that networks begin with: there must be large advantages, and weights that are clipped.
SIZES = {
    "narrow": {"hidden": 5, "batch_size": 23, "select": 3, "spread": 2.0},
    "small": {"hidden": 11, "batch_size": 24, "select": 6, "spread": 2.5},
    "hopper": {"hidden": 256, "batch_size": 256, "select": 32, "spread": 5.0},
}


def value_networks(size):
    """ReLU, and a V that is normalized. In wide networks some ReLU is always about to turn: those have Mish."""
    hidden, activation = SIZES[size]["hidden"], "mish" if size == "hopper" else "relu"
    return {
        "actor": shape([hidden, hidden], activation),
        "critic": shape([hidden, hidden], activation),
        "value": shape([hidden, hidden - 2], activation, True),
    }


def make_config(algorithm, size, agent):
    return configuration(algorithm, SIZES[size]["batch_size"], 700, agent)


# Networks.


def value(network, states, activation):
    """V(s), [B]."""
    return ensemble(network, states, activation)[0, :, 0]


def mean_action(actor, states, activation):
    network = {name: x for name, x in actor.items() if name != "log_std"}
    return jnp.tanh(ensemble(network, states, activation)[0])


fast_value, fast_action = compiled(value), compiled(mean_action)


# Losses and their gradients.


def log_density(actions, mean, log_std):
    """ln of a diagonal Gaussian's density. Where a tanh is part of the mean, the density knows nothing of it."""
    return jnp.sum(-(((actions - mean) / jnp.exp(log_std)) ** 2) / 2 - log_std - math.log(2 * math.pi) / 2, -1)


def actor_loss(actor, states, actions, weights, activation):
    log_std = jnp.clip(actor["log_std"], *LOG_STD)
    return -jnp.mean(weights * log_density(actions, mean_action(actor, states, activation), log_std))


def critic_loss(critics, states, actions, targets, activation):
    """Each critic's squared error; their sum."""
    return jnp.mean(jnp.sum((values(critics, states, actions, activation) - targets) ** 2, 0))


actor_gradient = compiled(jax.value_and_grad(actor_loss))
critic_gradient = compiled(jax.value_and_grad(critic_loss))


# One update.


def least(critics, states, actions, config):
    """min_k Q_k(s, a), [B]."""
    return fast_values(critics, states, actions, config["agent"]["critic"]["activation"]).min(0)


def update_critics(config, state, inputs, network, gradient=critic_gradient):
    """The critics toward r + γ·V(s') with the V given, and their targets after them."""
    agent, activation = config["agent"], config["agent"]["critic"]["activation"]
    next_v = fast_value(network, inputs["next_observations"], agent["value"]["activation"])
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * next_v
    loss, gradients = gradient(state["critic"], inputs["observations"], inputs["actions"], targets, activation)
    out = adam_step(state, "critic", gradients, agent["critic_learning_rate"], config["step"])
    target = follow(state["target_critic"], out["critic"], agent["ema_rate"])
    return out | {"target_critic": target, "critic_loss": loss, "targets": targets, "target_q_mean": targets.mean()}


def update(config, state, inputs, update_value, weigh, gradient=critic_gradient):
    """All that must come out, with an algorithm's step of V given q, its weights given A before they are clipped, and
    its critics' gradient; also q and those weights.
    """
    agent, s, a = config["agent"], inputs["observations"], inputs["actions"]
    q = least(state["target_critic"], s, a, config)
    out = update_value(q)

    # The actor, with the V that has just moved.
    v = fast_value(out["value"], s, agent["value"]["activation"])
    unclipped = weigh(q - v)
    weights = np.clip(unclipped, 0, LARGEST_WEIGHT)
    loss, gradients = actor_gradient(state["actor"], s, a, weights, agent["actor"]["activation"])
    rate = agent["actor_learning_rate"]
    if agent.get("actor_rate_decays", True):
        rate = decayed(rate, config)
    out |= adam_step(state, "actor", gradients, rate, config["step"])
    out |= {"actor_loss": loss, "v_mean": v.mean(), "advantage_mean": (q - v).mean(), "weight_mean": weights.mean()}
    out["clipped_share"] = np.mean(unclipped > LARGEST_WEIGHT)
    return out | update_critics(config, state, inputs, out["value"], gradient), q, unclipped


def act(config, state, inputs):
    """The policy's mean, with the actor as it is before the update."""
    activation = config["agent"]["actor"]["activation"]
    return {"select.actions": fast_action(state["actor"], inputs["select_observations"], activation)}


# Random states and inputs.


def widened(network, by):
    """The network with a last layer as many times as large."""
    name = max(name for name in network if name.endswith(".kernel"))
    return network | {name: single(by * network[name])}


def random_values(config, rng, spread):
    """Critics and V, before they are given moments."""
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    networks = {
        "critic": random_network(rng, o + a, agent["critic"], 1, CRITICS),
        "value": random_network(rng, o, agent["value"], 1, 1),
    }
    return {name: widened(network, spread) for name, network in networks.items()}


def random_state(config, rng, spread):
    o, a = config["observation_dim"], config["action_dim"]
    state = {"actor": random_network(rng, o, config["agent"]["actor"], a, 1)} | random_values(config, rng, spread)
    state["actor"]["log_std"] = single(rng.uniform(-1, 0.5, a))
    last = f"{len(config['agent']['critic']['hidden'])}.bias"
    state["critic"][last] = single(state["critic"][last] + spread / 10)
    state["target_critic"] = near(rng, state["critic"])
    for name in "actor", "critic", "value":
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng, size):
    batch, rows = random_batch(rng, config), (SIZES[size]["select"], config["observation_dim"])
    return batch | {"select_observations": single(rng.normal(size=rows))}
