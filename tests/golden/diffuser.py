"""One update of Diffuser (Janner et al. 2022), and how it plans. Windows are [..., H, a + o], each step action then state."""

import math

import jax
import jax.numpy as jnp
import numpy as np

from networks import adam_step, compiled, configuration, follow, mish, near, random_moments, single

TAPS = 5
# Large rates, so that a mistake in an optimizer or an average is far larger than float32's rounding.
AGENT = {
    "gamma": 0.997,
    "terminal_penalty": 100.0,
    "first_action_weight": 10.0,
    "learning_rate": 0.02,
    "value_updates": 1500,
    "ema_rate": 0.05,
    "ema_every": 10,
    "ema_start": 1000,
}
SMALL = {"diffusion_steps": 4, "guidance": {"steps": 2, "scale": 0.5, "stop": 1}, "candidates": 5, "replan_every": 2}
PAPER = {"diffusion_steps": 20, "guidance": {"steps": 2, "scale": 0.1, "stop": 2}, "candidates": 4, "replan_every": 1}
# The step: one in which the networks that plan move, or in which they become copies.
STEPS = {"diffuser": 1000, "diffuser-attention": 990}
FOLDERS = {"diffuser": (40, "small"), "diffuser-attention": (41, "small")}
NETWORKS = {
    ("diffuser", "small"): {"horizon": 16, "channels": 4, "multipliers": [1, 4], "groups": 2},
    ("diffuser", "hopper"): {"horizon": 32, "channels": 32, "multipliers": [1, 2, 4, 8], "groups": 8},
    # The networks for HalfCheetah.
    ("diffuser-attention", "small"): {
        "horizon": 4,
        "channels": 4,
        "multipliers": [1, 2, 4],
        "groups": 1,
        "attention": {"heads": 2, "width": 3},
    },
    ("diffuser-attention", "hopper"): {
        "horizon": 4,
        "channels": 32,
        "multipliers": [1, 4, 8],
        "groups": 8,
        "attention": {"heads": 4, "width": 32},
    },
}


def make_config(variant, size):
    size = "small" if size == "narrow" else size
    paper = size == "hopper"
    agent = {"network": NETWORKS[variant, size]} | AGENT | (PAPER if paper else SMALL)
    config = configuration("diffuser", 8 if paper else 6, STEPS[variant], agent)
    return config if paper else config | {"observation_dim": 5, "action_dim": 2}


# Layers over windows x [B, L, C], by the names of their parameters.


def convolution(p, name, x, stride=1):
    """With as many zeros before the first step as a middle tap needs, and after the last."""
    taps = len(p[f"{name}.kernel"])
    ends = (taps // 2, taps // 2)
    y = jax.lax.conv_general_dilated(x, p[f"{name}.kernel"], (stride,), [ends], dimension_numbers=("NWC", "WIO", "NWC"))
    return y + p[f"{name}.bias"]


def transposed(p, name, x):
    """Four taps, stride 2, one step cut off at each end: a convolution of the steps with zeros between them."""
    kernel = jnp.flip(p[f"{name}.kernel"].transpose(1, 0, 2), 0)
    spread = {"lhs_dilation": (2,), "dimension_numbers": ("NWC", "WIO", "NWC")}
    return jax.lax.conv_general_dilated(x, kernel, (1,), [(2, 2)], **spread) + p[f"{name}.bias"]


def linear(p, name, x):
    return x @ p[f"{name}.kernel"] + p[f"{name}.bias"]


def normed(p, name, x, groups):
    x = convolution(p, name, x)
    parts = x.reshape(*x.shape[:2], groups, -1)
    mean = parts.mean((1, 3), keepdims=True)
    parts = (parts - mean) / jnp.sqrt(parts.var((1, 3), keepdims=True) + 1e-5)
    return mish(parts.reshape(x.shape) * p[f"{name}.scale"] + p[f"{name}.shift"])


def block(p, name, x, time, groups):
    y = normed(p, f"{name}.0", x, groups) + linear(p, f"{name}.time", mish(time))[:, None]
    y = normed(p, f"{name}.1", y, groups)
    return y + (linear(p, f"{name}.skip", x) if f"{name}.skip.kernel" in p else x)


def attend(p, name, x, attention):
    if attention is None:
        return x
    heads, width = attention
    y = (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + 1e-5)
    y = (y * p[f"{name}.scale"] + p[f"{name}.shift"]) @ p[f"{name}.queries.kernel"]
    q, k, v = (part.reshape(*x.shape[:2], heads, width) for part in jnp.split(y, 3, -1))
    context = jnp.einsum("blhd,blhe->bhde", jax.nn.softmax(k, 1), v)
    y = jnp.einsum("bhde,blhd->blhe", context, q / math.sqrt(width))
    return x + linear(p, f"{name}.out", y.reshape(*x.shape[:2], -1))


def embed(p, t):
    """Of t from 1 to T."""
    half = len(p["time.0.kernel"]) // 2
    angles = (t[:, None] - 1) * jnp.exp(-jnp.arange(half) * math.log(10_000) / (half - 1))
    return linear(p, "time.1", mish(linear(p, "time.0", jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], -1))))


def clean(p, x, t, groups, attention):
    """The U-Net: the window without noise."""
    time, levels, kept = embed(p, t), sum(name.endswith("double.kernel") for name in p), []
    for i in range(levels + 1):
        x = block(p, f"down.{i}.0", x, time, groups)
        x = attend(p, f"down.{i}.attention", block(p, f"down.{i}.1", x, time, groups), attention)
        kept.append(x)
        x = convolution(p, f"down.{i}.halve", x, 2) if i < levels else x
    x = attend(p, "middle.attention", block(p, "middle.0", x, time, groups), attention)
    x = block(p, "middle.1", x, time, groups)
    for i in range(levels):
        x = block(p, f"up.{i}.0", jnp.concatenate([x, kept.pop()], -1), time, groups)
        x = attend(p, f"up.{i}.attention", block(p, f"up.{i}.1", x, time, groups), attention)
        x = transposed(p, f"up.{i}.double", x)
    return linear(p, "out", normed(p, "last", x, groups))


def worth(p, x, t, groups):
    """The value network, [B]."""
    time, levels = embed(p, t), sum(name.endswith("halve.kernel") for name in p) - 2
    for i in range(levels):
        x = block(p, f"level.{i}.1", block(p, f"level.{i}.0", x, time, groups), time, groups)
        x = convolution(p, f"level.{i}.halve", x, 2)
    for i in range(2):
        x = convolution(p, f"middle.{i}.halve", block(p, f"middle.{i}.0", x, time, groups), 2)
    x = jnp.concatenate([x.reshape(len(x), -1), time], -1)
    return linear(p, "head.1", mish(linear(p, "head.0", x)))[:, 0]


# Losses and their gradients.


def model_loss(p, noisy, windows, t, weights, groups, attention):
    """The weighted loss; also the unweighted one of each number of the first step."""
    error = (clean(p, noisy, t, groups, attention) - windows) ** 2
    return jnp.mean(weights * error), jnp.mean(error[:, 0], 0)


def value_loss(p, noisy, returns, t, groups):
    values = worth(p, noisy, t, groups)
    return jnp.mean((values - returns) ** 2), values


def sum_of_values(x, p, t, groups):
    """Its gradient is that of each window's value; also the values."""
    values = worth(p, x, t, groups)
    return values.sum(), values


model_gradient = compiled(jax.value_and_grad(model_loss, has_aux=True))
value_gradient = compiled(jax.value_and_grad(value_loss, has_aux=True))
pull = compiled(jax.value_and_grad(sum_of_values, has_aux=True))
fast_clean = compiled(clean)


# One update.


def schedule(steps):
    """β and ᾱ at 0 … T."""
    f = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * math.pi / 2) ** 2
    beta = np.append(0.0, np.minimum(1 - f[1:] / f[:-1], 0.999))
    return beta, np.cumprod(1 - beta)


def static(config):
    """Groups and, where there is attention, its heads and width."""
    network = config["agent"]["network"]
    attention = network.get("attention")
    return network["groups"], attention and (attention["heads"], attention["width"])


def update(config, state, inputs):
    """All that must come out."""
    agent, step, a = config["agent"], config["step"], config["action_dim"]
    groups, attention = static(config)
    windows, t, returns = inputs["windows"], inputs["t"], inputs["returns"]
    _, alpha_bar = schedule(agent["diffusion_steps"])
    share = alpha_bar[t][:, None, None]
    noisy = np.sqrt(share) * windows + np.sqrt(1 - share) * inputs["epsilon"]
    is_first = (np.arange(windows.shape[1]) == 0)[:, None]
    is_action = np.arange(windows.shape[2]) < a
    noisy = np.where(is_first & ~is_action, windows, noisy)

    weights = np.where(is_first, np.where(is_action, agent["first_action_weight"], 0.0), 1.0)
    (loss, first), gradients = model_gradient(state["model"], noisy, windows, t, weights, groups, attention)
    out = {"noisy_windows": noisy, "model_loss": loss, "first_action_loss": first[:a].mean()}
    out |= adam_step(state, "model", gradients, agent["learning_rate"], step)
    out |= {"value": state["value"], "return_mean": returns.mean()}
    learning = ["model"]
    if step < agent["value_updates"]:
        learning.append("value")
        (loss, values), gradients = value_gradient(state["value"], noisy, returns, t, groups)
        out |= {"value_loss": loss, "value_mean": values.mean()}
        out |= adam_step(state, "value", gradients, agent["learning_rate"], step)

    out |= {f"target_{name}": state[f"target_{name}"] for name in ("model", "value")}
    if step % agent["ema_every"] == 0:
        rate = agent["ema_rate"] if step >= agent["ema_start"] else 1
        out |= {f"target_{name}": follow(state[f"target_{name}"], out[name], rate) for name in learning}
    return out, None


def act(config, state, inputs):
    """The first actions of each plan, and of the one that the last guidance values most, with the networks that plan as they
    are before the update.
    """
    agent, a, noise = config["agent"], config["action_dim"], inputs["select_noise"]
    groups, attention = static(config)
    steps, n, plans, horizon, width = noise.shape
    beta, alpha_bar = schedule(steps)
    first = np.repeat(inputs["select_observations"], plans, 0)
    noise = noise.reshape(steps, n * plans, horizon, width)
    x = noise[0].copy()
    x[:, 0, a:] = first
    for t in range(steps, 0, -1):
        times = np.full(len(x), t)
        variance = beta[t] * (1 - alpha_bar[t - 1]) / (1 - alpha_bar[t])
        for _ in range(agent["guidance"]["steps"]):
            (_, values), gradient = pull(x, state["target_value"], times, groups)
            # Its authors count t from 0.
            scale = agent["guidance"]["scale"] if t - 1 >= agent["guidance"]["stop"] else 0
            x = x + scale * variance * gradient
            x[:, 0, a:] = first
        x0 = fast_clean(state["target_model"], x, times, groups, attention)
        of_x0 = math.sqrt(alpha_bar[t - 1]) * beta[t] / (1 - alpha_bar[t])
        of_x = math.sqrt(1 - beta[t]) * (1 - alpha_bar[t - 1]) / (1 - alpha_bar[t])
        x = of_x0 * x0 + of_x * x
        if t > 1:
            x = x + math.sqrt(variance) * noise[steps - t + 1]
        x[:, 0, a:] = first
    actions = x[:, : agent["replan_every"], :a].reshape(n, plans, -1)
    values = values.reshape(n, plans)
    index = values.argmax(-1)
    out = {"select.candidates": actions, "select.values": values, "select.index": index}
    return out | {"select.actions": actions[np.arange(n), index, :a]}


# Random states and inputs.


def random_layers(rng, config, inputs):
    """Functions that add parameters to a dictionary, which they share."""
    p, channels, attention = {}, config["channels"], config.get("attention")

    def kernel(name, shape, outputs, products, bias=True):
        limit = 1 / math.sqrt(products)
        p[f"{name}.kernel"] = single(rng.uniform(-limit, limit, shape))
        if bias:
            p[f"{name}.bias"] = single(rng.uniform(-limit, limit, outputs))

    def norm(name, width):
        p[f"{name}.scale"] = single(rng.uniform(0.5, 1.5, width))
        p[f"{name}.shift"] = single(rng.uniform(-0.3, 0.3, width))

    def dense(name, rows, columns):
        kernel(name, (rows, columns), columns, rows)

    def smooth(name, rows, columns, taps=TAPS):
        kernel(name, (taps, rows, columns), columns, taps * rows)

    def unit(name, rows, columns):
        smooth(name, rows, columns)
        norm(name, columns)

    def residual(name, rows, columns):
        unit(f"{name}.0", rows, columns)
        dense(f"{name}.time", channels, columns)
        unit(f"{name}.1", columns, columns)
        if rows != columns:
            dense(f"{name}.skip", rows, columns)

    def look(name, width):
        if attention:
            inner = attention["heads"] * attention["width"]
            norm(name, width)
            kernel(f"{name}.queries", (width, 3 * inner), None, width, bias=False)
            dense(f"{name}.out", inner, width)

    dense("time.0", channels, 4 * channels)
    dense("time.1", 4 * channels, channels)
    widths = [inputs, *(channels * multiplier for multiplier in config["multipliers"])]
    return p, widths, kernel, dense, smooth, unit, residual, look


def random_model(rng, config, inputs):
    p, widths, kernel, dense, smooth, unit, residual, look = random_layers(rng, config, inputs)
    levels = len(widths) - 1
    for i in range(levels):
        residual(f"down.{i}.0", widths[i], widths[i + 1])
        residual(f"down.{i}.1", widths[i + 1], widths[i + 1])
        look(f"down.{i}.attention", widths[i + 1])
        if i < levels - 1:
            smooth(f"down.{i}.halve", widths[i + 1], widths[i + 1], 3)
    residual("middle.0", widths[-1], widths[-1])
    look("middle.attention", widths[-1])
    residual("middle.1", widths[-1], widths[-1])
    for i, (below, above) in enumerate(zip(widths[-1:1:-1], widths[-2:0:-1], strict=True)):
        residual(f"up.{i}.0", 2 * below, above)
        residual(f"up.{i}.1", above, above)
        look(f"up.{i}.attention", above)
        kernel(f"up.{i}.double", (above, 4, above), above, 4 * above)
    unit("last", widths[1], widths[1])
    dense("out", widths[1], inputs)
    return p


def random_value(rng, config, inputs):
    p, widths, _, dense, smooth, _, residual, _ = random_layers(rng, config | {"attention": None}, inputs)
    length = config["horizon"]
    for i in range(len(widths) - 1):
        residual(f"level.{i}.0", widths[i], widths[i + 1])
        residual(f"level.{i}.1", widths[i + 1], widths[i + 1])
        smooth(f"level.{i}.halve", widths[i + 1], widths[i + 1], 3)
        length = (length + 1) // 2
    for i, narrow in enumerate((widths[-1] // 2, widths[-1] // 4)):
        residual(f"middle.{i}.0", widths[-1] // 2**i, narrow)
        smooth(f"middle.{i}.halve", narrow, narrow, 3)
        length = (length + 1) // 2
    flat = length * narrow
    dense("head.0", flat + config["channels"], flat // 2)
    dense("head.1", flat // 2, 1)
    return p


def random_state(config, rng):
    network, inputs = config["agent"]["network"], config["observation_dim"] + config["action_dim"]
    state = {"model": random_model(rng, network, inputs), "value": random_value(rng, network, inputs)}
    for name in "model", "value":
        state[f"target_{name}"] = near(rng, state[name])
        state |= random_moments(rng, name, state[name])
    return state


def random_inputs(config, rng):
    agent, b, o = config["agent"], config["batch_size"], config["observation_dim"]
    shape, n = (agent["network"]["horizon"], config["action_dim"] + o), 3
    return {
        "windows": single(rng.normal(size=(b, *shape))),
        "returns": single(rng.normal(size=b)),
        "t": rng.permutation(np.arange(b) % agent["diffusion_steps"] + 1),
        "epsilon": single(rng.normal(size=(b, *shape))),
        "select_observations": single(rng.normal(size=(n, o))),
        "select_noise": single(rng.normal(size=(agent["diffusion_steps"], n, agent["candidates"], *shape))),
    }


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where plans' values are so close that rounding could choose another."""
    state, inputs = random_state(config, rng), random_inputs(config, rng)
    expected = act(config, state, inputs)
    values = np.sort(expected["select.values"])
    if np.any(values[:, -1] - values[:, -2] < 1e-3 * abs(values).max()):
        return None
    return state, inputs, update(config, state, inputs)[0] | expected
