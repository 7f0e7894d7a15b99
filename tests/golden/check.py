"""`make.py --check`: every gradient of the update against finite differences of losses in plain NumPy."""

import math

import jax
import numpy as np

import make


def numpy_mlp(parameters, prefix, layers, x):
    for i in range(layers):
        x = x @ parameters[f"{prefix}{i}.kernel"] + parameters[f"{prefix}{i}.bias"]
        if i < layers - 1:
            x = x * np.tanh(np.log1p(np.exp(x)))
    return x


def numpy_values(critics, s, a):
    count = len(critics["0.bias"])
    x = np.concatenate([s, a], -1)
    return np.array([numpy_mlp({n: p[k] for n, p in critics.items()}, "", 4, x)[:, 0] for k in range(count)])


def numpy_noise(actor, s, noisy, t):
    angles = np.outer(t, 10_000 ** (-np.arange(8) / 7))
    time = numpy_mlp(actor, "time.", 2, np.hstack([np.cos(angles), np.sin(angles)]))
    return numpy_mlp(actor, "trunk.", 4, np.hstack([s, noisy, time]))


def slope(loss, at, direction, width=1e-5):
    """Central difference of loss along a direction, both dictionaries of arrays."""
    shifted = [loss({n: x + sign * width * direction[n] for n, x in at.items()}) for sign in (1, -1)]
    return (shifted[0] - shifted[1]) / (2 * width)


def check():
    """Every gradient of the update against finite differences, along random directions."""
    rng = np.random.default_rng(0)
    config, state, inputs, out = make.make(0, "quad", "small")
    agent = config["agent"]
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))
    out = jax.tree.map(np.asarray, out)
    noisy = out["noisy_actions"]

    def compare(name, loss, at, gradient):
        for _ in range(20):
            direction = {n: rng.normal(size=x.shape) for n, x in at.items()}
            expected = slope(loss, at, direction)
            found = sum(np.sum(gradient[n] * direction[n]) for n in at)
            size = math.sqrt(sum(np.sum(g**2) for g in gradient.values()))
            assert abs(found - expected) < 1e-6 * size, (name, found, expected)

    def gradient_of(name):
        """The gradient before clipping, recovered from what Adam's first moment became."""
        m, new = state[f"adam_m.{name}"], out[f"adam_m.{name}"]
        clipped = {n: (new[n] - make.ADAM["beta1"] * m[n]) / (1 - make.ADAM["beta1"]) for n in m}
        return {n: g * max(1.0, out[f"{name}_gradient_norm"] / agent["gradient_clip"]) for n, g in clipped.items()}

    compare(
        "critic loss",
        lambda critic: np.mean((numpy_values(critic, s, a) - out["targets"]) ** 2),
        state["critic"],
        gradient_of("critic"),
    )

    # The actor's loss from g_k alone; λ and u are constants in its gradient.
    g = out["critic_action_gradients"] / out["q_scale"]
    level = np.sqrt(1 - out["schedule.alpha_bar"][t - 1])
    predicted = numpy_noise(state["actor"], s, noisy, t)
    alignment = np.einsum("ba,kba->kb", predicted / np.linalg.norm(predicted, axis=1)[:, None], g)
    nu = (1 - agent["nu_ema_rate"]) * state["nu_squared"][0] + agent["nu_ema_rate"] * np.var(np.mean(alignment, 0))
    weight = nu / (nu + np.var(alignment, 0) / agent["tau"] + agent["delta"])
    assert np.allclose(weight, out["lambda"], rtol=1e-6) and 0 < weight.min() < weight.max() < 1

    def loss(actor):
        predicted = numpy_noise(actor, s, noisy, t)
        pull = (weight * level)[:, None] * predicted * g.mean(0)
        return state["eta"][0] * np.mean((epsilon - predicted) ** 2) + np.mean(pull)

    assert abs(loss(state["actor"]) - out["actor_loss"]) < 1e-6
    compare("actor loss", loss, state["actor"], gradient_of("actor"))

    critic = out["target_critic"]
    for k in range(agent["critics"]):
        gradient = {"a": out["critic_action_gradients"][k]}
        compare(f"Q-gradient {k}", lambda x: numpy_values(critic, s, x["a"])[k].sum(), {"a": noisy}, gradient)

    follows = {n: x for n, x in out["target_actor"].items() if np.any(x != state["target_actor"][n])}
    assert follows.keys() == state["actor"].keys(), "the target actor must move in this step"
    # The variants between them must take both sides of the clipping.
    for variant, clips in ("quad", True), ("maxq", True), ("dac", False):
        config, _, _, out = make.make(1, variant, "small")
        norms = [float(out[f"{name}_gradient_norm"]) for name in ("critic", "actor")]
        assert (max(norms) > config["agent"]["gradient_clip"]) == clips, (variant, norms)
    print("gradients agree with finite differences")
