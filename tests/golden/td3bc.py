"""One update of TD3+BC (Fujimoto and Gu 2021), in the order of its authors' code, or of ReBRAC (Tarasov et al. 2023), in that of
CORL: with its policy's step, or without.
"""

import implicit
import jax
import jax.numpy as jnp
import numpy as np
from implicit import CRITICS, SIZES, critic_gradient, fast_action, mean_action, widened

from networks import adam_step, compiled, fast_values, follow, near, random_moments, random_network, shape, single, values

# The step: in every second one the policy moves, too; TD3+BC counts from 1. Of the online steps 30 % are over in `rebrac-online`, and
# in `td3-bc-online` 70 %, when the distance to the data has its smallest factor.
FOLDERS = {
    "td3-bc": (51, "small"),
    "td3-bc-critic": (52, "small"),
    "td3-bc-online": (64, "small"),
    "rebrac": (54, "small"),
    "rebrac-critic": (55, "small"),
    "rebrac-online": (65, "small"),
}
VARIANTS = {
    "td3-bc": {"step": 701},
    "td3-bc-critic": {"step": 700},
    "td3-bc-online": {"step": 2701, "online_steps": 1000},
    "rebrac": {"step": 700},
    "rebrac-critic": {"step": 701},
    "rebrac-online": {"step": 2300, "online_steps": 1000},
}
AGENT = {
    "gamma": 0.99,
    "target_noise": 0.2,
    "target_noise_limit": 0.25,
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "ema_rate": 0.05,
    "actor_every": 2,
    "online_cloning": 0.6,
}


def make_config(variant, size):
    hidden, activation = SIZES[size]["hidden"], "mish" if size == "hopper" else "relu"
    networks = dict.fromkeys(("actor", "critic"), shape([hidden, hidden], activation))
    if variant.startswith("td3-bc"):
        return implicit.make_config("td3-bc", size, networks | AGENT | {"weight": 2.5}) | VARIANTS[variant]
    networks["critic"] = shape([hidden, hidden], activation, True) | {"norm_after": True}
    own = {"actor_penalty": 0.4, "critic_penalty": 0.2}
    return implicit.make_config("rebrac", size, networks | AGENT | own) | VARIANTS[variant]


def cloning_of(config):
    """Factor of the distance to the data, as CORL's decay_coef: what is left of the online steps, but no less than its smallest."""
    if "online_steps" not in config:
        return 1.0
    left = (config["total_steps"] + config["online_steps"] - config["step"]) / config["online_steps"]
    return max(config["agent"]["online_cloning"], left)


def actor_losses(actor, critics, states, actions, weight, cloning, activation):
    """TD3+BC's: the actor's loss, and the distance to the data in it."""
    taken = mean_action(actor, states, activation)
    q = values(critics, states, taken, activation)[0]
    distance = jnp.mean((taken - actions) ** 2)
    return -weight / jax.lax.stop_gradient(jnp.mean(jnp.abs(q))) * jnp.mean(q) + cloning * distance, distance


def penalized_losses(actor, critics, states, actions, penalty, cloning, activation):
    """ReBRAC's."""
    taken = mean_action(actor, states, activation)
    q = jnp.min(values(critics, states, taken, activation, after=True), 0)
    distance = jnp.sum((taken - actions) ** 2, -1)
    scale = jax.lax.stop_gradient(1 / jnp.mean(jnp.abs(q)))
    return jnp.mean(penalty * cloning * distance - scale * q), jnp.mean(distance)


def normed_critic_loss(critics, states, actions, targets, activation):
    return jnp.sum(jnp.mean((values(critics, states, actions, activation, after=True) - targets) ** 2, 1))


actor_gradient = compiled(jax.value_and_grad(actor_losses, has_aux=True))
penalized_gradient = compiled(jax.value_and_grad(penalized_losses, has_aux=True))
normed_critic_gradient = compiled(jax.value_and_grad(normed_critic_loss))


def noisy_actions(config, state, inputs):
    agent = config["agent"]
    noise = np.clip(agent["target_noise"] * inputs["target_noise"], -agent["target_noise_limit"], agent["target_noise_limit"])
    return fast_action(state["target_actor"], inputs["next_observations"], agent["actor"]["activation"]) + noise


def update(config, state, inputs):
    agent, s, a, step = config["agent"], inputs["observations"], inputs["actions"], config["step"]
    activation, rebrac = agent["critic"]["activation"], config["algorithm"] == "rebrac"
    next_actions = np.clip(noisy_actions(config, state, inputs), -1, 1)
    next_q = fast_values(state["target_critic"], inputs["next_observations"], next_actions, activation, 1e-6, rebrac).min(0)
    if rebrac and "online_steps" not in config:
        next_q = next_q - agent["critic_penalty"] * ((next_actions - inputs["next_actions"]) ** 2).sum(-1)
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * next_q
    critic_loss, gradients = (normed_critic_gradient if rebrac else critic_gradient)(state["critic"], s, a, targets, activation)
    out = state | adam_step(state, "critic", gradients, agent["critic_learning_rate"], step)
    out |= {"targets": targets, "target_q_mean": targets.mean(), "critic_loss": critic_loss}
    if step % agent["actor_every"] == (0 if rebrac else agent["actor_every"] - 1):
        moved, weight = (penalized_gradient, "actor_penalty") if rebrac else (actor_gradient, "weight")
        weights = agent[weight], cloning_of(config)
        (loss, distance), gradients = moved(state["actor"], out["critic"], s, a, *weights, activation)
        out |= adam_step(state, "actor", gradients, agent["actor_learning_rate"], step // agent["actor_every"])
        out["target_critic"] = follow(state["target_critic"], out["critic"], agent["ema_rate"])
        # CORL's target follows the policy from before its step.
        out["target_actor"] = follow(state["target_actor"], (state if rebrac else out)["actor"], agent["ema_rate"])
        out["of_actor"] = np.stack([loss, distance])
    return out | {"actor_loss": out["of_actor"][0], "bc_loss": out["of_actor"][1]}, None


act = implicit.act


def random_state(config, rng, size):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    state = {
        "actor": widened(random_network(rng, o, agent["actor"], a, 1), 2),
        "critic": widened(random_network(rng, o + a, agent["critic"], 1, CRITICS), SIZES[size]["spread"]),
    }
    state |= {f"target_{name}": near(rng, network) for name, network in state.items()}
    state["of_actor"] = single([0.7, 0.3])
    for name in "actor", "critic":
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng, size):
    shape = config["batch_size"], config["action_dim"]
    inputs = implicit.random_inputs(config, rng, size) | {"target_noise": single(rng.normal(size=shape))}
    if config["algorithm"] == "rebrac" and "online_steps" not in config:
        inputs["next_actions"] = single(rng.uniform(-0.99999, 0.99999, shape))
    return inputs


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where noise and actions are not clipped, or come close to it."""
    agent, state, inputs = config["agent"], random_state(config, rng, size), random_inputs(config, rng, size)
    noise = agent["target_noise"] * inputs["target_noise"]
    for clipped, limit in (noise, agent["target_noise_limit"]), (noisy_actions(config, state, inputs), 1):
        beyond = np.abs(clipped) - limit
        if np.any(np.abs(beyond) < 1e-5) or not np.any(beyond > 0):
            return None
    return state, inputs, update(config, state, inputs)[0] | act(config, state, inputs)
