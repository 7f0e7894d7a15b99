"""One update of IQL (Kostrikov et al. 2021), equation numbers are its paper's: docs/golden.md."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from networks import (
    ADAM,
    adam_step,
    compiled,
    decayed,
    ensemble,
    follow,
    layers,
    near,
    random_moments,
    random_network,
    single,
    values,
)

CRITICS = 2
LARGEST_WEIGHT = 100.0
LOG_STD = -5.0, 2.0

# Large rates, so that a mistake in an optimiser or an average is far larger than float32's rounding.
AGENT = {
    "gamma": 0.99,
    "expectile": 0.7,
    "temperature": 3.0,
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
VARIANTS = ("iql",)


def make_config(variant, size):
    return {
        "algorithm": variant,
        "observation_dim": 11,
        "action_dim": 3,
        "batch_size": SIZES[size]["batch_size"],
        "total_steps": 2000,
        "step": 700,
        "adam": ADAM,
        "agent": {"hidden": SIZES[size]["hidden"]} | AGENT,
    }


# Networks: V and the actor are ensembles of one.


def value(network, states):
    """V(s), [B]."""
    return ensemble(network, states)[0, :, 0]


def mean_action(actor, states):
    return jnp.tanh(ensemble({name: x for name, x in actor.items() if name != "log_std"}, states)[0])


fast_value, fast_values, fast_action = compiled(value), compiled(values), compiled(mean_action)


# Losses and their gradients.


def value_loss(network, states, q, expectile):
    """Eq. 5."""
    u = q - value(network, states)
    return jnp.mean(jnp.abs(expectile - (u < 0)) * u**2)


def critic_loss(critics, states, actions, targets):
    """Eq. 6, for each critic; their sum."""
    return jnp.mean(jnp.sum((values(critics, states, actions) - targets) ** 2, 0))


def actor_loss(actor, states, actions, weights):
    """Eq. 7, as a loss. The tanh is part of the mean: the density knows nothing of it."""
    log_std = jnp.clip(actor["log_std"], *LOG_STD)
    standard = (actions - mean_action(actor, states)) / jnp.exp(log_std)
    log_pi = jnp.sum(-(standard**2) / 2 - log_std - math.log(2 * math.pi) / 2, -1)
    return -jnp.mean(weights * log_pi)


value_gradient = compiled(jax.value_and_grad(value_loss))
critic_gradient = compiled(jax.value_and_grad(critic_loss))
actor_gradient = compiled(jax.value_and_grad(actor_loss))


def update(config, state, inputs):
    """All that must come out; and, for `draw`, q and the exponents of the weights."""
    agent, step = config["agent"], config["step"]
    s, a, next_states = (inputs[name] for name in ("observations", "actions", "next_observations"))
    out = {}

    # V, by expectile regression towards the lower of the two target values.
    q = fast_values(state["target_critic"], s, a).min(0)
    out["value_loss"], gradients = value_gradient(state["value"], s, q, agent["expectile"])
    out |= adam_step(state, "value", gradients, agent["value_learning_rate"], step)

    # The actor, by regression weighted with advantages over the V that has just moved.
    v = fast_value(out["value"], s)
    exponents = agent["temperature"] * (q - v)
    weights = np.minimum(np.exp(exponents), LARGEST_WEIGHT)
    out["actor_loss"], gradients = actor_gradient(state["actor"], s, a, weights)
    out |= adam_step(state, "actor", gradients, decayed(agent["actor_learning_rate"], config), step)
    out |= {"v_mean": v.mean(), "advantage_mean": (q - v).mean(), "weight_mean": weights.mean()}
    out["clipped_share"] = np.mean(np.exp(exponents) > LARGEST_WEIGHT)

    # The critics, towards the new V of the next state; and their targets.
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * fast_value(out["value"], next_states)
    out["critic_loss"], gradients = critic_gradient(state["critic"], s, a, targets)
    out |= adam_step(state, "critic", gradients, agent["critic_learning_rate"], step)
    out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])
    out["q_mean"] = targets.mean()
    return out, {"q": q, "exponents": exponents}


def act(state, inputs):
    """The policy's mean, with the actor as it is before the update."""
    return {"select.actions": fast_action(state["actor"], inputs["select_observations"])}


# Random states and inputs.


def random_state(config, rng, size):
    o, a, hidden = config["observation_dim"], config["action_dim"], [config["agent"]["hidden"]] * 3
    state = {
        "actor": random_network(rng, layers([o, *hidden, a], 1)),
        "critic": random_network(rng, layers([o + a, *hidden, 1], CRITICS)),
        "value": random_network(rng, layers([o, *hidden, 1], 1)),
    }
    state["actor"]["log_std"] = single(rng.uniform(-1, 0.5, a))
    for name in "critic", "value":
        state[name]["3.kernel"] = single(SIZES[size]["spread"] * state[name]["3.kernel"])
    state["critic"]["3.bias"] = single(state["critic"]["3.bias"] + 0.25)
    state["target_critic"] = near(rng, state["critic"])
    for name in "actor", "critic", "value":
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng, size):
    o, a, b, n = config["observation_dim"], config["action_dim"], config["batch_size"], SIZES[size]["select"]
    return {
        "observations": single(rng.normal(size=(b, o))),
        "actions": single(rng.uniform(-0.99999, 0.99999, (b, a))),
        "rewards": single(rng.normal(size=b)),
        "next_observations": single(rng.normal(size=(b, o))),
        "masks": (np.arange(b) % 4 != 3).astype(np.float64),
        "select_observations": single(rng.normal(size=(n, o))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where they do not show both sides of the expectile and of the clip."""
    state = random_state(config, rng, size)
    inputs = random_inputs(config, rng, size)
    expected, came = update(config, state, inputs)
    above = np.mean(came["q"] > fast_value(state["value"], inputs["observations"]))
    # No weight so close to the largest that rounding could take it to the other side.
    close = np.any(abs(came["exponents"] - math.log(LARGEST_WEIGHT)) < 2e-3)
    if close or not 0 < above < 1 or not 0 < expected["clipped_share"] < 0.5:
        return None
    return state, inputs, expected | act(state, inputs)
