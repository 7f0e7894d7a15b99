"""One update of CQL (Kumar et al. 2020), with the entropy's and, in a variant, the gap's multiplier learned; or of Cal-QL."""

import math

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from implicit import CRITICS, SIZES, critic_loss, log_density
from networks import adam_step, compiled, ensemble, fast_values, follow, near, random_moments, random_network
from networks import shape, single, values

LOG_STD = -20.0, 2.0
CLIPPED = 0.999
AGENT = {
    "gamma": 0.99,
    "weight": 3.0,
    "actions": 4,
    "samples": 1,
    "log_std": {"multiplier": 1.0, "offset": -1.0},
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "ema_rate": 0.05,
    "phases": {"cloning": 0, "learning": 1},
}
FOLDERS = {"cql": (27, "small"), "cql-lagrange": (28, "small"), "cql-cloning": (29, "small"), "cql-online": (66, "small")}
VARIANTS = {
    "cql": {},
    "cql-lagrange": {"samples": 5, "threshold": 0.5, "least_gap": 4.0, "phases": {"cloning": 1, "learning": 3}},
    "cql-cloning": {"phases": {"cloning": 1, "learning": 1}},
    "cql-online": {},
}


def make_config(variant, size):
    hidden, activation = SIZES[size]["hidden"], "mish" if size == "hopper" else "relu"
    networks = dict.fromkeys(("actor", "critic"), shape([hidden, hidden], activation))
    online = {"step": 2300, "online_steps": 1000} if variant == "cql-online" else {}
    return implicit.make_config("cql", size, networks | AGENT | VARIANTS[variant]) | online


# The policy, an ensemble of one: a = tanh(u).


def distribution(actor, states, activation):
    """Mean and ln σ of u, [B, a] each."""
    network = {name: x for name, x in actor.items() if name != "log_std_map"}
    mean, x = jnp.split(ensemble(network, states, activation)[0], 2, -1)
    return mean, jnp.clip(actor["log_std_map"][0] * x + actor["log_std_map"][1], *LOG_STD)


def squashed_density(u, mean, log_std):
    """ln π(tanh u): the normal density over the tanh's derivative, 1/cosh² u."""
    return log_density(u, mean, log_std) + 2 * jnp.sum(jnp.log(jnp.cosh(u)), -1)


def sampled(actor, states, noise, activation):
    """Actions with noise [B, S, a], and ln π of each, [B, S]."""
    mean, log_std = (x[:, None] for x in distribution(actor, states, activation))
    u = mean + jnp.exp(log_std) * noise
    return jnp.tanh(u), squashed_density(u, mean, log_std)


fast_sampled, fast_distribution = compiled(sampled), compiled(distribution)


# Losses and their gradients.


def actor_loss(actor, critics, batch, alpha, cloning, activation, critic_activation):
    """The loss; also the policy's actions and their ln π."""
    states, actions, noise = batch
    drawn, density = (x[:, 0] for x in sampled(actor, states, noise[:, None], activation))
    cloned = squashed_density(jnp.arctanh(actions), *distribution(actor, states, activation))
    worth = jnp.where(cloning, cloned, values(critics, states, drawn, critic_activation).min(0))
    return jnp.mean(alpha * density - worth), (drawn, density)


def gaps_of(critics, states, actions, others, densities, bounds, least, activation):
    """ln of the mean of exp Q, or its bound if that is larger, over other actions [B, M, a] less ln π, times M; less Q of the
    data's; [K, B].
    """
    repeated = jnp.broadcast_to(states[:, None], (*others.shape[:2], states.shape[-1]))
    q = jnp.maximum(values(critics, repeated, others, activation), bounds) - densities
    return jnp.maximum(jax.nn.logsumexp(q, -1) - values(critics, states, actions, activation), least)


def whole_critic_loss(critics, states, actions, targets, others, densities, bounds, least, weight, activation):
    """The critics' loss; also its first term and the gaps."""
    error = critic_loss(critics, states, actions, targets, activation)
    gaps = gaps_of(critics, states, actions, others, densities, bounds, least, activation)
    return error + weight * gaps.mean(-1).sum(), (error, gaps)


actor_gradient = compiled(jax.value_and_grad(actor_loss, has_aux=True))
critic_gradient = compiled(jax.value_and_grad(whole_critic_loss, has_aux=True))


# One update; all losses are of the networks before it.


def targets_of(config, state, inputs):
    """r + γ times the largest over next actions of the smaller Q̂."""
    agent, s = config["agent"], inputs["next_observations"]
    actions, _ = fast_sampled(state["actor"], s, inputs["target_noise"], agent["actor"]["activation"])
    states = np.broadcast_to(s[:, None], (*actions.shape[:2], s.shape[-1]))
    q = fast_values(state["target_critic"], states, actions, agent["critic"]["activation"]).min(0)
    return inputs["rewards"] + agent["gamma"] * inputs["masks"] * q.max(-1)


def other_actions(config, state, inputs):
    """Uniform actions, and the policy's at s' and at s; ln of the density of each, and its lower bound."""
    activation, uniform = config["agent"]["actor"]["activation"], inputs["uniform_actions"]
    following, next_density = fast_sampled(
        state["actor"], inputs["next_observations"], inputs["next_noise"], activation
    )
    current, density = fast_sampled(state["actor"], inputs["observations"], inputs["current_noise"], activation)
    flat = np.full(uniform.shape[:2], -uniform.shape[-1] * math.log(2))
    returns = inputs["returns"] if "online_steps" in config else np.full(len(uniform), -np.inf)
    bounds = np.concatenate([np.full(flat.shape, -np.inf), np.tile(returns[:, None], (1, 2 * uniform.shape[1]))], 1)
    return np.concatenate([uniform, following, current], 1), np.concatenate([flat, next_density, density], 1), bounds


def returns_of(config, inputs):
    """Discounted returns to the ends of episodes. One of equal rewards that does not terminate goes on forever."""
    gamma, rewards, returns = config["agent"]["gamma"], inputs["rewards"], np.zeros(config["batch_size"])
    ends = np.flatnonzero((inputs["masks"] == 0) | (inputs["timeouts"] == 1)) + 1
    for start, end in zip([0, *ends], ends, strict=False):
        failed = end - start > 1 and inputs["masks"][end - 1] == 1 and np.ptp(rewards[start:end]) == 0
        for i in reversed(range(start, end)):
            later = returns[i + 1] if i + 1 < end else 0.0
            returns[i] = rewards[i] / (1 - gamma) if failed else rewards[i] + gamma * later
    return returns


def actions_of(config, inputs):
    """The data's actions; a run that clones clips them, and not only while it clones."""
    return np.clip(inputs["actions"], -CLIPPED, CLIPPED) if config["agent"]["phases"]["cloning"] else inputs["actions"]


def update(config, state, inputs):
    """All that must come out."""
    agent, step, s, a = config["agent"], config["step"], inputs["observations"], actions_of(config, inputs)
    activations = agent["actor"]["activation"], agent["critic"]["activation"]
    rates = agent["actor_learning_rate"], agent["critic_learning_rate"]
    shares = agent["phases"]
    cloning = step * sum(shares.values()) < config["total_steps"] * shares["cloning"]

    out = {"targets": targets_of(config, state, inputs), "alpha_prime": 0.0, "alpha": np.exp(state["log_alpha"]["value"][0])}
    out["target_q_mean"] = out["targets"].mean()

    # The policy and α.
    batch = s, a, inputs["policy_noise"]
    arguments = state["critic"], batch, out["alpha"], cloning, *activations
    (out["actor_loss"], (out["policy_actions"], density)), gradients = actor_gradient(state["actor"], *arguments)
    moved = adam_step(state, "actor", gradients, rates[0], step)
    excess = density.mean() - config["action_dim"]
    moved |= adam_step(state, "log_alpha", {"value": -excess * np.ones(1)}, rates[0], step)
    out["entropy"] = -density.mean()

    # The critics and α'.
    weight = agent["weight"]
    if "threshold" in agent:
        out["alpha_prime"] = np.exp(state["log_alpha_prime"]["value"][0])
        weight = weight * out["alpha_prime"]
    arguments = s, a, out["targets"], *other_actions(config, state, inputs), agent.get("least_gap", -np.inf), weight
    (_, (out["critic_loss"], gaps)), gradients = critic_gradient(state["critic"], *arguments, activations[1])
    out |= {"gaps": gaps, "gap": gaps.mean()}
    moved |= adam_step(state, "critic", gradients, rates[1], step)
    if "threshold" in agent:
        slope = -weight * (gaps.mean() - agent["threshold"])  # that of e^x is e^x
        moved |= adam_step(state, "log_alpha_prime", {"value": slope * np.ones(1)}, rates[1], step)
    target = follow(state["target_critic"], moved["critic"], agent["ema_rate"])
    return state | moved | out | {"target_critic": target}, None


def act(config, state, inputs):
    """The tanh of the mean, before the update."""
    mean, _ = fast_distribution(state["actor"], inputs["select_observations"], config["agent"]["actor"]["activation"])
    return {"select.actions": np.tanh(mean)}


# Random states and inputs.


def random_state(config, rng):
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    actor = random_network(rng, o, agent["actor"], 2 * a, 1) | {"log_std_map": single([0.8, -0.9])}
    state = {"actor": actor, "critic": random_network(rng, o + a, agent["critic"], 1, CRITICS)}
    state["log_alpha"] = {"value": single(rng.uniform(-1, 0, 1))}
    if "threshold" in agent:
        state["log_alpha_prime"] = {"value": single(rng.uniform(0, 1, 1))}
    for name in list(state):
        state |= random_moments(rng, name, state[name])
    return state | {"target_critic": near(rng, state["critic"])}


def random_inputs(config, rng, size):
    agent, b, a = config["agent"], config["batch_size"], config["action_dim"]
    each = b, agent["actions"], a
    batch = implicit.random_inputs(config, rng, size)
    # A quarter of the data's actions at the limit, so that clipping shows.
    actions = np.where(rng.random((b, a)) < 0.25, np.copysign(0.99999, batch["actions"]), batch["actions"])
    if "online_steps" in config:
        # Episodes of up to four rows, each of which leads to the next; the first fails.
        batch["rewards"][:3] = -0.25
        batch["timeouts"] = np.isin(np.arange(b) % 17, (2, 8, 16)) * batch["masks"]
        batch["timeouts"][-1] = batch["masks"][-1]
        goes_on = (batch["masks"] == 1) & (batch["timeouts"] == 0)
        batch["next_observations"][goes_on] = batch["observations"][1:][goes_on[:-1]]
        batch["returns"] = single(returns_of(config, batch))
    return batch | {
        "actions": single(actions),
        "policy_noise": single(rng.normal(size=(b, a))),
        "target_noise": single(rng.normal(size=(b, agent["samples"], a))),
        "uniform_actions": single(rng.uniform(-1, 1, each)),
        "next_noise": single(rng.normal(size=each)),
        "current_noise": single(rng.normal(size=each)),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where gaps are not on both sides of their bound, if they have one, or close to
    it, or values are close to theirs.
    """
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    expected, _ = update(config, state, inputs)
    least = config["agent"].get("least_gap")
    if least is not None:
        bounded = expected["gaps"] == least
        if np.any(abs(expected["gaps"] - least)[~bounded] < 1e-3) or not 0.1 < bounded.mean() < 0.9:
            return None
    if "online_steps" in config:
        others, _, bounds = other_actions(config, state, inputs)
        states = np.broadcast_to(inputs["observations"][:, None], (*others.shape[:2], config["observation_dim"]))
        excess = fast_values(state["critic"], states, others, config["agent"]["critic"]["activation"]) - bounds
        if np.any(abs(excess) < 1e-4) or not 0.4 < np.mean(excess > 0) < 0.9:
            return None
    return state, inputs, expected | act(config, state, inputs)
