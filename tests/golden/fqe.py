"""One update of fitted Q evaluation (Le et al. 2019): Q toward r + γ·mask·Q̂(s', a') with the actions a' of a policy, clipped."""

import implicit
import numpy as np

from networks import adam_step, fast_values, follow, near, random_moments, random_network, shape, single
from onestep import critic_gradient

FOLDERS = {"fqe": (50, "small")}


def make_config(variant, size):
    hidden, activation = implicit.SIZES[size]["hidden"], "mish" if size == "hopper" else "relu"
    agent = {
        "critic": shape([hidden, hidden], activation),
        "gamma": 0.97,
        "learning_rate": 0.02,
        "weight_decay": 0.3,
        "ema_rate": 0.05,
    }
    return implicit.make_config("fqe", size, agent)


def q_values(network, states, actions, config, inputs):
    """Q in the rewards' units: the network's are so many times the scale from the offset."""
    offset, scale, _, _ = inputs["units"]
    return offset + scale * fast_values(network, states, actions, config["agent"]["critic"]["activation"])[0]


def unclipped(config, state, inputs):
    next_q = q_values(state["target_critic"], inputs["next_observations"], inputs["next_actions"], config, inputs)
    return inputs["rewards"] + config["agent"]["gamma"] * inputs["masks"] * next_q


def update(config, state, inputs):
    agent = config["agent"]
    offset, scale, least, most = inputs["units"]
    targets = np.clip(unclipped(config, state, inputs), least, most)
    loss, gradients = critic_gradient(
        state["critic"], inputs["observations"], inputs["actions"], (targets - offset) / scale, agent["critic"]["activation"]
    )
    moved = adam_step(state, "critic", gradients, agent["learning_rate"], config["step"], agent["weight_decay"])
    target = follow(state["target_critic"], moved["critic"], agent["ema_rate"])
    out = state | moved | {"target_critic": target, "target_q_mean": targets.mean(), "critic_loss": loss}
    return out, None


def act(config, state, inputs):
    """It has no policy: the values of some actions, before the update."""
    values = q_values(state["target_critic"], inputs["observations"], inputs["actions"], config, inputs)
    return {"select.values": values}


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where not both bounds clip some targets, or come close to one."""
    o, a, b = config["observation_dim"], config["action_dim"], config["batch_size"]
    critic = random_network(rng, o + a, config["agent"]["critic"], 1, 1)
    state = {"critic": critic, "target_critic": near(rng, critic)} | random_moments(rng, "critic", critic)
    inputs = implicit.random_inputs(config, rng, size)
    del inputs["select_observations"]
    inputs["next_actions"] = single(rng.uniform(-0.99999, 0.99999, (b, a)))
    inputs["units"] = single([3.0, 5.0, -1.0, 8.0])
    targets = unclipped(config, state, inputs)
    least, most = inputs["units"][2:]
    close = np.any(abs(targets - least) < 1e-3) or np.any(abs(targets - most) < 1e-3)
    if close or not np.any(targets < least) or not np.any(targets > most):
        return None
    return state, inputs, update(config, state, inputs)[0] | act(config, state, inputs)
