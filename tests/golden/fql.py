"""One update of FQL (Park, Li and Levine 2025), in the order of its authors' code: all losses are those of the networks before
it, and the target critics follow the critics from before it. In chunks of several steps it is QC-FQL's (Li, Zhou and Levine 2025),
and with the best of the flow's chunks in place of the one-step policy's action it is QC's.
"""

import jax
import jax.numpy as jnp
import numpy as np

from networks import adam_step, compiled, configuration, ensemble, fast_values, follow, near, random_batch, random_moments
from networks import random_network, shape, single, values

CRITICS = 2
FOLDERS = {"fql": (56, "small"), "fql-normalized": (57, "small"), "fql-chunks": (58, "small"), "qc": (59, "small")}
VARIANTS = {"fql": 700, "fql-normalized": 701, "fql-chunks": 702, "qc": 703}
ONE_STEP = ("alpha", "normalize_q")  # of FQL alone
SIZES = {
    "narrow": {"hidden": 5, "batch_size": 23, "select": 3},
    "small": {"hidden": 11, "batch_size": 24, "select": 6},
    "hopper": {"hidden": 256, "batch_size": 256, "select": 32},
}
AGENT = {
    "gamma": 0.99,
    "alpha": 3.0,
    "flow_steps": 10,
    "learning_rate": 0.02,
    "ema_rate": 0.05,
    "candidates": 5,
}


def make_config(variant, size):
    hidden, normalized = SIZES[size]["hidden"], variant == "fql-normalized"
    networks = {
        "actor": shape([hidden, hidden, hidden - 2], "gelu"),
        "critic": shape([hidden, hidden - 1], "gelu", True) | {"norm_after": True},
    }
    own = {"target": "min" if normalized else "mean", "normalize_q": normalized}
    chunk = {"chunk": 3} if variant in ("fql-chunks", "qc") else {}
    agent = networks | AGENT | own | chunk
    if variant == "qc":
        agent = {name: value for name, value in agent.items() if name not in ONE_STEP}
    name = "qc" if variant == "qc" else "fql"
    return configuration(name, SIZES[size]["batch_size"], VARIANTS[variant], agent)


def width(config):
    """Numbers in a chunk."""
    return config["action_dim"] * config["agent"].get("chunk", 1)


# Networks: flow and one-step policy are ensembles of one.


def one_step(actor, states, noise, activation):
    return ensemble(actor, jnp.concatenate([states, noise], -1), activation)[0]


def velocity(flow, states, x, times, activation):
    return ensemble(flow, jnp.concatenate([states, x, times[..., None]], -1), activation)[0]


fast_one_step, fast_velocity = compiled(one_step), compiled(velocity)


# Losses and their gradients.


def critic_loss(critics, states, actions, targets, activation):
    return jnp.mean((values(critics, states, actions, activation, after=True) - targets) ** 2)


def flow_loss(flow, states, actions, within, start, times, activation):
    between = (1 - times[:, None]) * start + times[:, None] * actions
    return jnp.mean(within * (velocity(flow, states, between, times, activation) - (actions - start)) ** 2)


def actor_loss(actor, critics, states, noise, led, numbers, activation, critic_activation):
    """The actor's loss, with the distance to where the flow led, and −Q."""
    alpha, normalize_q = numbers
    taken = one_step(actor, states, noise, activation)
    distance = jnp.mean((taken - led) ** 2)
    q = jnp.mean(values(critics, states, jnp.clip(taken, -1, 1), critic_activation, after=True), 0)
    size = jax.lax.stop_gradient(jnp.mean(jnp.abs(q)))
    q_loss = -jnp.mean(q) / jnp.where(normalize_q, size, 1.0)
    return alpha * distance + q_loss, (distance, q_loss)


critic_gradient = compiled(jax.value_and_grad(critic_loss))
flow_gradient = compiled(jax.value_and_grad(flow_loss))
actor_gradient = compiled(jax.value_and_grad(actor_loss, has_aux=True))


# One update.


def windows(config, inputs):
    """The chunk from each row on, for rows of several episodes: its actions, the last of the episode over and over once it
    is over; where they are within the episode; its discounted rewards; the state after it; and what that is discounted by. As
    QC's authors cut it, it goes over a success, after which nothing is expected of the state at its end.
    """
    agent, chunks = config["agent"], []
    gamma = agent.get("gamma", 1.0)
    if agent.get("chunk", 1) == 1:
        within = np.ones_like(inputs["actions"])
        return inputs["actions"], within, inputs["rewards"], inputs["next_observations"], gamma * inputs["masks"]
    for row in range(config["batch_size"]):
        rows = [row]
        while len(rows) < agent["chunk"] and inputs["ends"][rows[-1]] < 0.5:
            rows.append(rows[-1] + 1)
        n, missing = len(rows), agent["chunk"] - len(rows)
        chunks.append(
            (
                inputs["actions"][rows + [rows[-1]] * missing].ravel(),
                np.repeat([1.0] * n + [0.0] * missing, config["action_dim"]),
                sum(gamma**i * inputs["rewards"][rows[i]] for i in range(n)),
                inputs["next_observations"][rows[-1]],
                gamma**n * inputs["masks"][rows].min(),
            )
        )
    return [np.array(column) for column in zip(*chunks, strict=True)]


def joined(inputs):
    """The rows as episodes of up to seven, each of which leads to the next one. Every fourth is a success, which ends few."""
    rows = np.arange(len(inputs["masks"]))
    inputs["ends"] = np.isin(rows % 17, (3, 8, 15, 16)).astype(float)
    inputs["ends"][-1] = 1
    goes_on = np.flatnonzero(inputs["ends"] == 0)
    inputs["next_observations"][goes_on] = inputs["observations"][goes_on + 1]
    return inputs


def reduced(agent, q):
    return q.min(0) if agent["target"] == "min" else q.mean(0)


def best_actions(config, state, states, noise):
    """The best by the critics of where the flow leads from each state, what it is chosen from, and by how much it is the best."""
    agent, n = config["agent"], config["agent"]["candidates"]
    several = np.repeat(states, n, 0)
    led = flow_actions(config, state["flow"], several, noise)
    drawn = np.clip(led, -1, 1)
    q = reduced(agent, fast_values(state["critic"], several, drawn, agent["critic"]["activation"], 1e-6, True))
    q = np.asarray(q).reshape(-1, n)
    ordered = np.sort(q, 1)
    return drawn.reshape(-1, n, width(config))[np.arange(len(q)), q.argmax(1)], led, ordered[:, -1] - ordered[:, -2]


def flow_actions(config, flow, states, noise):
    """The end of the flow in Euler steps, before it is clipped."""
    steps, x = config["agent"]["flow_steps"], noise
    for i in range(steps):
        times = np.full(len(states), i / steps)
        x = x + fast_velocity(flow, states, x, times, config["agent"]["actor"]["activation"]) / steps
    return x


def update(config, state, inputs):
    """All that must come out; and what is clipped on the way."""
    agent, s, step = config["agent"], inputs["observations"], config["step"]
    activation, critic_activation = agent["actor"]["activation"], agent["critic"]["activation"]
    a, within, rewards, after, discounts = windows(config, inputs)
    if config["algorithm"] == "qc":
        clipped, next_actions, _ = best_actions(config, state, after, inputs["next_noise"])
    else:
        next_actions = fast_one_step(state["actor"], after, inputs["next_noise"], activation)
        clipped = np.clip(next_actions, -1, 1)
    next_q = fast_values(state["target_critic"], after, clipped, critic_activation, 1e-6, True)
    targets = rewards + discounts * reduced(agent, next_q)
    out = dict(state) | {"targets": targets, "target_q_mean": targets.mean()}
    out["critic_loss"], of_critics = critic_gradient(state["critic"], s, a, targets, critic_activation)
    given = s, a, within, inputs["start_noise"], inputs["times"]
    out["bc_loss"], of_flow = flow_gradient(state["flow"], *given, activation)
    gradients = {"critic": of_critics, "flow": of_flow}
    out["target_critic"] = follow(state["target_critic"], state["critic"], agent["ema_rate"])
    if config["algorithm"] == "qc":
        for name, gradient in gradients.items():
            out |= adam_step(state, name, gradient, agent["learning_rate"], step)
        return out, next_actions
    led = flow_actions(config, state["flow"], s, inputs["policy_noise"])
    taken = fast_one_step(state["actor"], s, inputs["policy_noise"], activation)

    out["flow_actions"] = np.clip(led, -1, 1)
    given = state["critic"], s, inputs["policy_noise"], out["flow_actions"], (agent["alpha"], agent["normalize_q"])
    (out["actor_loss"], parts), of_actor = actor_gradient(state["actor"], *given, activation, critic_activation)
    out["distill_loss"], out["q_loss"] = parts
    for name, gradient in (gradients | {"actor": of_actor}).items():
        out |= adam_step(state, name, gradient, agent["learning_rate"], step)
    return out, np.concatenate([next_actions, led, taken])


def act(config, state, inputs):
    """The policy's draws, and the smaller of their values by the critics that choose."""
    agent, noise = config["agent"], inputs["select_noise"][0]
    states = np.broadcast_to(inputs["select_observations"][:, None], noise.shape[:-1] + (config["observation_dim"],))
    if config["algorithm"] == "qc":
        flat = states.reshape(-1, config["observation_dim"]), noise.reshape(-1, width(config))
        drawn, critics = flow_actions(config, state["flow"], *flat).reshape(noise.shape), state["critic"]
    else:
        drawn, critics = fast_one_step(state["actor"], states, noise, agent["actor"]["activation"]), state["target_critic"]
    drawn = np.clip(drawn, -1, 1)
    q = fast_values(critics, states, drawn, agent["critic"]["activation"], 1e-6, True).min(0)
    return {"select.candidates": drawn, "select.q": q}


# Random states and inputs.


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], width(config)
    state = {
        "actor": random_network(rng, o + a, agent["actor"], a, 1),
        "flow": random_network(rng, o + a + 1, agent["actor"], a, 1),
        "critic": random_network(rng, o + a, agent["critic"], 1, CRITICS),
    }
    # Actions that are beyond ±1 now and then.
    last = f"{len(agent['actor']['hidden'])}.kernel"
    if config["algorithm"] == "qc":
        del state["actor"]
    else:
        state["actor"][last] = single(1.5 * state["actor"][last])
    for name in list(state):
        state |= random_moments(rng, name, state[name])
    return state | {"target_critic": near(rng, state["critic"])}


def random_inputs(config, rng, size):
    b, n = config["batch_size"], SIZES[size]["select"]
    o, a, agent = config["observation_dim"], width(config), config["agent"]
    inputs = random_batch(rng, config) | {
        name: single(rng.normal(size=(b, a))) for name in ("start_noise", "policy_noise", "next_noise")
    }
    if config["algorithm"] == "qc":
        del inputs["policy_noise"]
        inputs["next_noise"] = single(rng.normal(size=(b * agent["candidates"], a)))
    if "chunk" in agent:
        inputs = joined(inputs)
    return inputs | {
        "times": single(rng.uniform(size=b)),
        "select_observations": single(rng.normal(size=(n, o))),
        "select_noise": single(rng.normal(size=(1, n, agent["candidates"], a))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where what is clipped is so close to ±1 that rounding could turn a gradient on or
    off, or is never beyond it, or where two chunks are nearly the best.
    """
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    expected, bounded = update(config, state, inputs)
    room = 1e-4 if size != "hopper" else 0
    if np.any(abs(abs(bounded) - 1) < room) or not np.any(abs(bounded) > 1):
        return None
    if config["algorithm"] == "qc":
        after = windows(config, inputs)[3]
        if np.any(best_actions(config, state, after, inputs["next_noise"])[2] < 1e-4):
            return None
    return state, inputs, expected | act(config, state, inputs)
