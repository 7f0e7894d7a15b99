"""One update of SfBC (Chen et al. 2022) in each of its phases: cloning, a round of the critic, and planning."""

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from implicit import SIZES
from networks import adam_step, compiled, fast_values, mlp, random_moments, random_network, shape, single, values

AGENT = {
    "gamma": 0.9,
    "evaluations": 7,
    "samples": 4,
    "planning_temperature": 0.2,
    "candidates": 6,
    "averaged": 3,
    "temperature": 0.1,
    "actor_learning_rate": 0.02,
    "critic_learning_rate": 0.03,
    "shortest_episode": 1,
    "phases": {"behavior": 3, "critic": 2, "planning": 3},
}
# The step and all steps. Phases have shares of 3, 2, 3 and 2 tenths; of three planning steps the last one is taken.
FOLDERS = {"sfbc-behavior": (40, "small"), "sfbc-critic": (41, "small"), "sfbc-planning": (42, "small")}
VARIANTS = {"sfbc-behavior": (300, 2000), "sfbc-critic": (1700, 2000), "sfbc-planning": (7, 10)}
HIDDEN = {"narrow": [6, 5], "small": [12, 7, 5], "hopper": [128, 64, 32]}
FREQUENCIES, EMBEDDING = 16, 32


def make_config(variant, size):
    hidden, (step, total) = SIZES[size]["hidden"], VARIANTS[variant]
    networks = {"actor": shape(HIDDEN[size], "silu"), "critic": shape([hidden, hidden], "silu")}
    config = implicit.make_config("sfbc", size, networks | AGENT)
    return config | {"step": step, "total_steps": total}


# The noise process: β_t = 0.1 + 19.9 t.


def ln_signal(t):
    return -19.9 * t**2 / 4 - 0.1 * t / 2


def deviation(t):
    return np.sqrt(1 - np.exp(2 * ln_signal(t)))


# The noise predictor.


def layer(network, name, x):
    return x @ network[f"{name}.kernel"] + network[f"{name}.bias"]


def block(network, name, x, condition):
    inner = jax.nn.silu(layer(network, f"{name}.first", x)) + layer(network, f"{name}.condition", condition)
    outer = jax.nn.silu(layer(network, f"{name}.second", inner))
    return outer + (layer(network, f"{name}.skip", x) if f"{name}.skip.kernel" in network else x)


def predict_noise(network, frequencies, states, noisy, t):
    """ε_θ of shapes [..., o], [..., a], [...]."""
    angles = 2 * jnp.pi * t[..., None] * frequencies
    time = layer(network, "time", jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], -1))
    condition = jnp.concatenate([jax.nn.silu(layer(network, "state", states)), time], -1)
    for i in range(2):
        condition = jax.nn.silu(layer(network, f"mix.{i}", condition))
    blocks = sum(name.startswith("down.") and name.endswith("first.bias") for name in network)
    x, narrowed = noisy, []
    for i in range(blocks):
        x = block(network, f"down.{i}", x, condition)
        narrowed.append(x)
    x = block(network, "middle", x, condition)
    for i in range(blocks - 1):
        x = block(network, f"up.{i}", jnp.concatenate([narrowed.pop(), x], -1), condition)
    return layer(network, "last", jnp.concatenate([narrowed.pop(), x], -1))


fast_noise = compiled(predict_noise)


def bc_loss(network, frequencies, states, noisy, t, epsilon):
    return jnp.mean(jnp.sum((predict_noise(network, frequencies, states, noisy, t) - epsilon) ** 2, -1))


def critic_loss(critic, states, actions, targets, activation):
    return jnp.mean((values(critic, states, actions, activation)[0] - targets) ** 2)


bc_gradient = compiled(jax.value_and_grad(bc_loss))
critic_gradient = compiled(jax.value_and_grad(critic_loss))


# The sampler: DPM-Solver's single steps. Those of order 3 come first; the last make the evaluations come out even.


def orders(evaluations):
    thirds, rest = divmod(evaluations, 3)
    return [3] * (thirds - 1) + [2, 1] if rest == 0 else [3] * thirds + [rest]


def solve(x, evaluations, noise):
    """From t = 1 to 0.001; noise predicts that of x at one time."""
    times = np.linspace(1, 1e-3, evaluations + 1)

    def half_log_ratio(t):
        return ln_signal(t) - np.log(deviation(t))

    first = 0
    for order in orders(evaluations):
        start, *middle, end = times[first : first + order + 1]
        h = half_log_ratio(end) - half_log_ratio(start)
        r = [(half_log_ratio(t) - half_log_ratio(start)) / h for t in middle]
        epsilon = noise(x, start)

        def ahead(t, part, x=x, epsilon=epsilon, start=start, h=h):
            return np.exp(ln_signal(t) - ln_signal(start)) * x - deviation(t) * np.expm1(part * h) * epsilon

        outcome = ahead(end, 1)
        if order == 2:
            change = noise(ahead(middle[0], r[0]), middle[0]) - epsilon
            outcome = outcome - deviation(end) * np.expm1(h) * change / (2 * r[0])
        if order == 3:
            change = noise(ahead(middle[0], r[0]), middle[0]) - epsilon
            bend = np.expm1(r[1] * h) / (r[1] * h) - 1
            second = ahead(middle[1], r[1]) - r[1] / r[0] * deviation(middle[1]) * bend * change
            change = noise(second, middle[1]) - epsilon
            outcome = outcome - deviation(end) * (np.expm1(h) / h - 1) * change / r[1]
        x, first = outcome, first + order
    return x


def sample(config, state, inputs, states, noise):
    """The clone's actions in states [n, o] with noise [n, samples, a]; also the states, once for each action."""
    states = np.broadcast_to(states[:, None], (*noise.shape[:-1], states.shape[-1]))

    def predict(x, t):
        return fast_noise(state["actor"], inputs["frequencies"], states, x, np.full(x.shape[:-1], t))

    return solve(noise, config["agent"]["evaluations"], predict), states


def q_values(config, state, states, actions):
    return fast_values(state["critic"], states, actions, config["agent"]["critic"]["activation"])[0]


# Planning.


def planned(config, inputs, values):
    """Returns backwards through each episode: at least the state's value."""
    returns, after = np.zeros_like(values), 0.0
    for i in reversed(range(len(values))):
        ends = inputs["masks"][i] < 0.5 or inputs["timeouts"][i] > 0.5
        after = max(inputs["rewards"][i] + config["agent"]["gamma"] * (0.0 if ends else after), values[i])
        returns[i] = after
    return returns


# One update.


def update(config, state, inputs):
    """All that must come out; and, in planning, the returns' gains over those without values."""
    agent, step, shares = config["agent"], config["step"], config["agent"]["phases"]
    out = state | dict.fromkeys(("bc_loss", "critic_loss", "target_q_mean", "v_mean"), 0.0)
    s, a = inputs["observations"], inputs["actions"]
    lengths = [shares[name] for name in ("behavior", "critic", "planning", "critic")]
    begins = [config["total_steps"] * sum(lengths[:i]) // sum(lengths) for i in range(4)]
    phase = max(i for i in range(4) if begins[i] <= step)
    steps = step - begins[phase]

    if phase == 0:
        t, epsilon = inputs["t"], inputs["epsilon"]
        noisy = np.exp(ln_signal(t))[:, None] * a + deviation(t)[:, None] * epsilon
        loss, gradients = bc_gradient(state["actor"], inputs["frequencies"], s, noisy, t, epsilon)
        out |= {"noisy_actions": noisy, "bc_loss": loss}
        return out | adam_step(state, "actor", gradients, agent["actor_learning_rate"], steps), None

    if phase != 2:
        targets = state["targets"]
        loss, gradients = critic_gradient(state["critic"], s, a, targets, agent["critic"]["activation"])
        out |= {"critic_loss": loss, "target_q_mean": targets.mean()}
        return out | adam_step(state, "critic", gradients, agent["critic_learning_rate"], steps), None

    # The last third of all states; values of the others are there.
    here = np.arange(len(s)) >= len(s) * steps // (begins[3] - begins[2])
    actions, states = sample(config, state, inputs, s[here], inputs["planning_noise"])
    q = q_values(config, state, states, actions)
    weights = np.exp((q - q.max(-1, keepdims=True)) / agent["planning_temperature"])
    mean, spread = state["scale"]
    v = mean + spread * (weights * q).sum(-1) / weights.sum(-1)
    values = np.array(state["values"])
    values[here] = v
    returns = planned(config, inputs, values)
    scale = np.array([returns.mean(), max(returns.std(), 0.1)])
    out |= {"v_mean": v.mean(), "values": values, "scale": scale, "targets": (returns - scale[0]) / scale[1]}
    return out, returns - planned(config, inputs, np.full(len(s), -np.inf))


def act(config, state, inputs):
    """Candidates and their values: which are drawn of these, and averaged, is up to chance."""
    candidates, states = sample(config, state, inputs, inputs["select_observations"], inputs["select_noise"])
    return {"select.candidates": candidates, "select.q": q_values(config, state, states, candidates)}


# Random states and inputs.


def random_predictor(rng, o, a, widths):
    network, narrowest = {}, widths[-1]

    def add(name, inputs, outputs):
        network.update(random_network(rng, inputs, shape([]), outputs, prefix=f"{name}."))
        for kind in "kernel", "bias":
            network[f"{name}.{kind}"] = network.pop(f"{name}.0.{kind}")

    def add_block(name, inputs, outputs):
        add(f"{name}.first", inputs, outputs)
        add(f"{name}.condition", narrowest, outputs)
        add(f"{name}.second", outputs, outputs)
        if inputs != outputs:
            add(f"{name}.skip", inputs, outputs)

    add("state", o, EMBEDDING)
    add("time", EMBEDDING, EMBEDDING)
    add("mix.0", 2 * EMBEDDING, narrowest)
    add("mix.1", narrowest, narrowest)
    for i, (inputs, outputs) in enumerate(zip([a, *widths], widths, strict=False)):
        add_block(f"down.{i}", inputs, outputs)
    add_block("middle", narrowest, narrowest)
    for i in range(len(widths) - 1):
        add_block(f"up.{i}", 2 * widths[-1 - i], widths[-2 - i])
    add("last", 2 * widths[0], a)
    return network


def random_state(config, rng):
    agent, o, a, b = config["agent"], config["observation_dim"], config["action_dim"], config["batch_size"]
    state = {
        "actor": random_predictor(rng, o, a, agent["actor"]["hidden"]),
        "critic": random_network(rng, o + a, agent["critic"], 1, 1),
    }
    # Actions of a network that has learned nothing are far from 0, and the farther the more it says.
    kernel = state["critic"]["0.kernel"]
    kernel[:, o:] = single(kernel[:, o:] / 100)
    state["actor"]["last.kernel"] = single(state["actor"]["last.kernel"] / 30)
    for name in "actor", "critic":
        state |= random_moments(rng, name, state[name])
    return state | {
        "values": single(rng.normal(size=b)),
        "targets": single(rng.normal(size=b)),
        "scale": single(np.array([0.5, 1.5])),
    }


def random_inputs(config, rng, size):
    agent, a, b, n = config["agent"], config["action_dim"], config["batch_size"], SIZES[size]["select"]
    inputs = implicit.random_inputs(config, rng, size)
    # Episodes of up to seven steps, of which some terminate; each row leads to the next.
    inputs["timeouts"] = np.isin(np.arange(b) % 17, (2, 8, 16)).astype(float) * inputs["masks"]
    inputs["timeouts"][-1] = inputs["masks"][-1]
    goes_on = (inputs["masks"] == 1) & (inputs["timeouts"] == 0)
    inputs["next_observations"][goes_on] = inputs["observations"][1:][goes_on[:-1]]
    rows = b - b * 2 // 3
    return inputs | {
        "t": single(rng.uniform(1e-5, 1, b)),
        "epsilon": single(rng.normal(size=(b, a))),
        # Slower than real ones, which turn too fast to be shaken.
        "frequencies": single(rng.normal(size=FREQUENCIES)),
        "planning_noise": single(rng.normal(size=(rows, agent["samples"], a))),
        "select_noise": single(rng.normal(size=(n, agent["candidates"], a))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where planning does not show both sides of the maximum, or comes close."""
    state, inputs = random_state(config, rng), random_inputs(config, rng, size)
    expected, gains = update(config, state, inputs)
    if gains is not None and not 0.2 < np.mean(gains > 0) < 0.8:
        return None
    return state, inputs, expected | act(config, state, inputs)
