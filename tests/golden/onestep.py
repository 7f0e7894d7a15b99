"""One update of one-step RL (Brandfonbrener et al. 2021) in each of its three phases."""

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from implicit import LARGEST_WEIGHT, SIZES, log_density, widened
from networks import adam_step, compiled, ensemble, fast_values, follow, near, random_moments, random_network
from networks import shape, single, values

AGENT = {
    "gamma": 0.99,
    "temperature": 3.0,
    "samples": 10,
    "learning_rate": 0.02,
    "ema_rate": 0.05,
    "ema_every": 2,
    "phases": {"behavior": 1, "critic": 2, "policy": 1},
}
# The step, of 2,000: the second of the critic's phase is the first at which its target moves.
FOLDERS = {"onestep-behavior": (21, "small"), "onestep-critic": (22, "small"), "onestep-policy": (23, "small")}
VARIANTS = {"onestep-behavior": 300, "onestep-critic": 501, "onestep-policy": 1700}


def make_config(variant, size):
    hidden, activation = SIZES[size]["hidden"], "mish" if size == "hopper" else "relu"
    networks = dict.fromkeys(("behavior", "critic"), shape([hidden, hidden], activation))
    return implicit.make_config("onestep", size, networks | AGENT) | {"step": VARIANTS[variant]}


def phase_of(config):
    """The network that learns, and the steps done since it began to."""
    shares, step, total = config["agent"]["phases"], config["step"], config["total_steps"]
    critic = total * shares["behavior"] // sum(shares.values())
    actor = total * (shares["behavior"] + shares["critic"]) // sum(shares.values())
    if step < critic:
        return "behavior", step
    return ("critic", step - critic) if step < actor else ("actor", step - actor)


# Networks: all are ensembles of one; the actor has the behavior's shape.


def gaussian(policy, states, activation):
    """Mean and ln σ of the policy's actions, [B, a] each."""
    mean, log_std = jnp.split(ensemble(policy, states, activation)[0], 2, -1)
    return jnp.tanh(mean), -5 + 2.5 * (jnp.tanh(log_std) + 1)


fast_gaussian = compiled(gaussian)


# Losses and their gradients.


def policy_loss(policy, states, actions, weights, activation):
    return -jnp.mean(weights * log_density(actions, *gaussian(policy, states, activation)))


def critic_loss(critics, states, actions, targets, activation):
    return jnp.mean((values(critics, states, actions, activation)[0] - targets) ** 2)


policy_gradient = compiled(jax.value_and_grad(policy_loss))
critic_gradient = compiled(jax.value_and_grad(critic_loss))


# One update.


def q_values(network, states, actions, config):
    return fast_values(network, states, actions, config["agent"]["critic"]["activation"])[0]


def targets_of(config, state, inputs):
    """r + γ·Q̂(s', a') with the action that the data takes next."""
    next_q = q_values(state["target_critic"], inputs["next_observations"], inputs["next_actions"], config)
    return inputs["rewards"] + config["agent"]["gamma"] * inputs["masks"] * next_q


def advantages_of(config, state, inputs):
    """Q(s, a) less the mean Q of actions that β draws."""
    s, agent = inputs["observations"], config["agent"]
    mean, log_std = fast_gaussian(state["behavior"], s, agent["behavior"]["activation"])
    noise = inputs["behavior_noise"].swapaxes(0, 1)
    actions = mean + np.exp(log_std) * noise  # as they are drawn, also beyond ±1
    baseline = q_values(state["critic"], np.broadcast_to(s, actions.shape[:1] + s.shape), actions, config).mean(0)
    return q_values(state["critic"], s, inputs["actions"], config) - baseline


def update(config, state, inputs):
    """All that must come out; and the advantages, in the last phase."""
    agent, (name, step) = config["agent"], phase_of(config)
    s, a = inputs["observations"], inputs["actions"]
    metrics = "behavior_loss", "critic_loss", "target_q_mean", "actor_loss", "advantage_mean", "weight_mean", "clipped_share"
    out = state | dict.fromkeys(metrics, 0.0)
    activation, rate = agent["critic" if name == "critic" else "behavior"]["activation"], agent["learning_rate"]

    if name == "behavior":
        out["behavior_loss"], gradients = policy_gradient(state[name], s, a, np.ones(len(s)), activation)
        out |= adam_step(state, name, gradients, rate, step)
        return out | {"actor": out["behavior"]}, None

    if name == "critic":
        out["targets"] = targets = targets_of(config, state, inputs)
        out["target_q_mean"] = targets.mean()
        out["critic_loss"], gradients = critic_gradient(state[name], s, a, targets, activation)
        out |= adam_step(state, name, gradients, rate, step)
        if (step + 1) % agent["ema_every"] == 0:
            out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])
        return out, None

    advantages = advantages_of(config, state, inputs)
    unclipped = np.exp(agent["temperature"] * advantages)
    weights = np.minimum(unclipped, LARGEST_WEIGHT)
    out["actor_loss"], gradients = policy_gradient(state[name], s, a, weights, activation)
    out |= {"advantage_mean": advantages.mean(), "weight_mean": weights.mean()}
    out["clipped_share"] = np.mean(unclipped > LARGEST_WEIGHT)
    return out | adam_step(state, name, gradients, rate, step), advantages


def act(config, state, inputs):
    """The mean of the policy, which is β until the policy's own phase, as it is before the update."""
    activation = config["agent"]["behavior"]["activation"]
    mean, _ = fast_gaussian(state["actor"], inputs["select_observations"], activation)
    return {"select.actions": mean}


# Random states and inputs.


def random_state(config, rng, size):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    state = {
        "behavior": random_network(rng, o, agent["behavior"], 2 * a, 1),
        "critic": widened(random_network(rng, o + a, agent["critic"], 1, 1), 2 * SIZES[size]["spread"]),
    }
    # A σ of about a half: where σ is small, losses are huge.
    last = f"{len(agent['behavior']['hidden'])}.bias"
    state["behavior"][last] = single(state["behavior"][last] + np.repeat([0.0, 1.0], a))
    learns = phase_of(config)[0] == "actor"
    state["actor"] = near(rng, state["behavior"]) if learns else dict(state["behavior"])
    state["target_critic"] = near(rng, state["critic"])
    for name in "behavior", "critic", "actor":
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng, size):
    b, a = config["batch_size"], config["action_dim"]
    inputs = implicit.random_inputs(config, rng, size)
    inputs["next_actions"] = single(rng.uniform(-0.99999, 0.99999, (b, a)))
    inputs["behavior_noise"] = single(rng.normal(size=(config["agent"]["samples"], b, a)).swapaxes(0, 1))
    return inputs


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where weights do not show both sides of the clip, or come close to it."""
    state, inputs = random_state(config, rng, size), random_inputs(config, rng, size)
    expected, advantages = update(config, state, inputs)
    if advantages is not None:
        exponents = config["agent"]["temperature"] * advantages
        close = np.any(abs(exponents - np.log(LARGEST_WEIGHT)) < 2e-3)
        if close or not 0 < expected["clipped_share"] < 0.5:
            return None
    return state, inputs, expected | act(config, state, inputs)
