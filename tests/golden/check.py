"""`make.py --check`: gradients against finite differences of losses in plain NumPy, and the committed folders."""

import json
import math
from time import monotonic

import numpy as np
from safetensors.numpy import load_file

import iql
import make
import quad
from networks import ADAM


def require(condition, *message):
    if not condition:
        raise SystemExit("check failed: " + " ".join(str(part) for part in message))


# Losses a third time, without JAX.


def numpy_mlp(parameters, prefix, layers, x):
    for i in range(layers):
        x = x @ parameters[f"{prefix}{i}.kernel"] + parameters[f"{prefix}{i}.bias"]
        if i < layers - 1:
            x = x * np.tanh(np.log1p(np.exp(x)))
    return x


def numpy_ensemble(networks, *inputs):
    """The outputs [K, B, out] of an ensemble of MLPs."""
    x = np.concatenate(inputs, -1)
    members = [{n: p[k] for n, p in networks.items()} for k in range(len(networks["0.bias"]))]
    return np.array([numpy_mlp(member, "", 4, x) for member in members])


def numpy_noise(actor, s, noisy, t):
    angles = np.outer(t, 10_000 ** (-np.arange(8) / 7))
    time = numpy_mlp(actor, "time.", 2, np.hstack([np.cos(angles), np.sin(angles)]))
    return numpy_mlp(actor, "trunk.", 4, np.hstack([s, noisy, time]))


def slope(loss, at, direction, width=1e-5):
    """Central difference of loss along a direction, both dictionaries of arrays."""
    shifted = [loss({n: x + sign * width * direction[n] for n, x in at.items()}) for sign in (1, -1)]
    return (shifted[0] - shifted[1]) / (2 * width)


def compare(name, loss, at, gradient):
    """The gradient against the loss's slope along random directions."""
    rng = np.random.default_rng(0)
    size = math.sqrt(sum(np.sum(g**2) for g in gradient.values()))
    for _ in range(20):
        direction = {n: rng.normal(size=x.shape) for n, x in at.items()}
        found = sum(np.sum(gradient[n] * direction[n]) for n in at)
        expected = slope(loss, at, direction)
        require(abs(found - expected) < 1e-6 * size, f"gradient of the {name}: {found}, by differences {expected}")


def gradient_of(name, config, state, out):
    """The gradient before any clipping, recovered from what Adam's first moment became."""
    old, new = state[f"adam_m.{name}"], out[f"adam_m.{name}"]
    clipped = {n: (new[n] - ADAM["beta1"] * old[n]) / (1 - ADAM["beta1"]) for n in old}
    limit = config["agent"].get("gradient_clip", math.inf)
    return {n: g * max(1.0, out.get(f"{name}_gradient_norm", 0.0) / limit) for n, g in clipped.items()}


def check_targets(config, state, inputs, out):
    """Eq. 20 once more, a number at a time: each critic over its samples, then the bound over critics."""
    agent, k = config["agent"], config["agent"]["critics"]
    samples = [out["next_actions"][:, i] for i in range(agent["samples"])]
    q = [numpy_ensemble(state["target_critic"], inputs["next_observations"], sample)[..., 0] for sample in samples]
    for row, target in enumerate(out["targets"]):
        over_samples = [[float(q[i][critic, row]) for i in range(agent["samples"])] for critic in range(k)]
        each = [max(x) if agent["target_reduce"] == "max" else sum(x) / len(x) for x in over_samples]
        mean = sum(each) / k
        bound = mean - agent["rho"] * math.sqrt(sum((x - mean) ** 2 for x in each) / k)
        wanted = inputs["rewards"][row] + agent["gamma"] * inputs["masks"][row] * bound
        require(abs(target - wanted) < 1e-9, f"target of row {row}: {target}, not {wanted}")


def check_quad_gradients(config, state, inputs, out):
    agent = config["agent"]
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))
    noisy, critic = out["noisy_actions"], out["target_critic"]

    def critic_loss(critic):
        return np.mean((numpy_ensemble(critic, s, a)[..., 0] - out["targets"]) ** 2)

    check_targets(config, state, inputs, out)
    require(abs(critic_loss(state["critic"]) - out["critic_loss"]) < 1e-9, "critic loss")
    compare("critic loss", critic_loss, state["critic"], gradient_of("critic", config, state, out))

    for k in range(agent["critics"] if agent["guidance"] != "none" else 0):
        gradient = {"a": out["critic_action_gradients"][k]}
        compare(f"value of critic {k}", lambda x: numpy_ensemble(critic, s, x["a"])[k].sum(), {"a": noisy}, gradient)

    # The actor's loss from the critics' action gradients alone; λ and u are constants in its gradient.
    weight, pull = np.zeros(len(s)), 0.0
    if agent["guidance"] != "none":
        g = out["critic_action_gradients"] / out["q_scale"]
        pull = g.mean(0)
        magnitudes = [abs(q) for network in numpy_ensemble(critic, s, a) for q in network[:, 0]]
        require(abs(sum(magnitudes) / len(magnitudes) + 1e-6 - out["q_scale"]) < 1e-9, "q_scale")
        weight = np.ones(len(s))
    if agent["guidance"] == "quad":
        predicted = numpy_noise(state["actor"], s, noisy, t)
        alignment = np.einsum("ba,kba->kb", predicted / np.linalg.norm(predicted, axis=1)[:, None], g)
        nu, kept = np.var(np.mean(alignment, 0)), 1 - agent["nu_ema_rate"]
        if state["nu_squared"][0] >= 0:
            nu = kept * state["nu_squared"][0] + (1 - kept) * nu
        denominator = nu + np.var(alignment, 0) / agent["tau"] + agent["delta"]
        weight = nu / denominator
        require(0 < weight.min() < weight.max() < 1, "λ must differ between rows")
        require(np.sum(100 * agent["delta"] > denominator) == round(out["delta_share"] * len(s)), "delta_share")
        require(np.allclose(weight, out["lambda"], rtol=1e-6), "λ")
    require(abs(weight.mean() - out["lambda_mean"]) < 1e-6, "lambda_mean")

    def actor_loss(actor):
        predicted = numpy_noise(actor, s, noisy, t)
        level = np.sqrt(1 - out["schedule.alpha_bar"][t - 1])
        guidance = (weight * level)[:, None] * predicted * pull
        return state["eta"][0] * np.mean((epsilon - predicted) ** 2) + np.mean(guidance)

    require(abs(actor_loss(state["actor"]) - out["actor_loss"]) < 1e-6, "actor loss")
    compare("actor loss", actor_loss, state["actor"], gradient_of("actor", config, state, out))


def check_quad_claims(name, variant, config, state, inputs, out):
    """That the folder reaches what it is there for."""
    wanted, agent = quad.VARIANTS[variant], config["agent"]
    _, came = quad.update(config, state, inputs)
    does = quad.what_eta_does(config, came)
    require(does == wanted.eta, f"{name}: η {does}, not {wanted.eta}")
    require((out["eta"] != state["eta"][0]) == (wanted.eta != "stays"), f"{name}: η")
    if "clipped" in wanted.eta:
        sign = 1 if wanted.eta.endswith("+1") else -1
        require(abs(out["eta"] - state["eta"][0] - sign * agent["eta"]["rate"]) < 1e-9, f"{name}: η's clip")
    if wanted.eta.startswith("at the"):
        require(out["eta"] == agent["eta"][wanted.eta.removeprefix("at the ")], f"{name}: η's bound")
    moved = {n for n, x in out["target_actor"].items() if np.any(x != state["target_actor"][n])}
    require(moved == (state["actor"].keys() if wanted.follows else set()), f"{name}: target actor moves in {moved}")
    norms = [out[f"{network}_gradient_norm"] for network in ("critic", "actor")]
    if variant == "quad":
        require(min(norms) > agent["gradient_clip"], f"{name}: both gradients must be clipped")
        require(0 < out["delta_share"] < 1, f"{name}: delta_share must be neither 0 nor 1")
    if variant == "dac":
        require(max(norms) < agent["gradient_clip"], f"{name}: no gradient may be clipped")


def check_iql_gradients(config, state, inputs, out):
    agent, s, a = config["agent"], inputs["observations"], inputs["actions"]
    q = np.minimum(*numpy_ensemble(state["target_critic"], s, a)[..., 0])

    def value(network, states):
        return numpy_ensemble(network, states)[0, :, 0]

    def value_loss(network):
        u = q - value(network, s)
        return np.mean(np.where(u < 0, 1 - agent["expectile"], agent["expectile"]) * u**2)

    weights = np.exp(agent["temperature"] * (q - value(out["value"], s)))
    clipped = weights > 100
    weights[clipped] = 100

    def actor_loss(actor):
        mean = np.tanh(numpy_ensemble({n: x for n, x in actor.items() if n != "log_std"}, s)[0])
        density = np.exp(-(((a - mean) / np.exp(actor["log_std"])) ** 2) / 2) / np.exp(actor["log_std"])
        return -np.mean(weights * np.log(density / math.sqrt(2 * math.pi)).sum(-1))

    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * value(out["value"], inputs["next_observations"])

    def critic_loss(critics):
        return sum(np.mean((q - targets) ** 2) for q in numpy_ensemble(critics, s, a)[..., 0])

    for name, loss in ("value", value_loss), ("actor", actor_loss), ("critic", critic_loss):
        require(abs(loss(state[name]) - out[f"{name}_loss"]) < 1e-9, f"{name} loss")
        compare(f"{name} loss", loss, state[name], gradient_of(name, config, state, out))
    for name, wanted in ("weight_mean", weights), ("clipped_share", clipped), ("q_mean", targets):
        require(abs(out[name] - np.mean(wanted)) < 1e-9, name)


def check_iql_claims(name, config, state, inputs, out):
    _, came = iql.update(config, state, inputs)
    u = came["q"] - numpy_ensemble(state["value"], inputs["observations"])[0, :, 0]
    require(0.2 < np.mean(u < 0) < 0.8, f"{name}: both sides of the expectile must be common")
    require(0.05 < out["clipped_share"] < 0.5, f"{name}: some weights must be clipped, most must not")


# The committed folders.


def check_files(name, config, *made):
    """The files on disk against what the script makes now, within float32's rounding."""
    folder = make.HERE / name
    require(json.loads((folder / "config.json").read_text()) == config, f"{name}: config.json differs")
    for file, tensors in zip(("state", "inputs", "expected"), made, strict=True):
        found, expected = load_file(folder / f"{file}.safetensors"), make.flatten(tensors)
        require(found.keys() == expected.keys(), f"{name}: {file} has other tensors: {found.keys() ^ expected.keys()}")
        for tensor, x in expected.items():
            y = found[tensor]
            require(y.shape == x.shape and y.dtype == x.dtype, f"{name}: {file} {tensor}: {y.shape} {y.dtype}")
            require(np.all(np.isfinite(y)), f"{name}: {file} {tensor} is not finite")
            room = 1e-6 if file == "expected" else 0
            require(make.distance(y, x) <= room, f"{name}: {file} {tensor} differs")


def check():
    start = monotonic()
    for name, (seed, variant, size) in make.FOLDERS.items():
        config, *made = make.make(seed, variant, size)
        check_files(name, config, *made)
        if config["algorithm"] == "quad":
            check_quad_gradients(config, *made)
            check_quad_claims(name, variant, config, *made)
        else:
            check_iql_gradients(config, *made)
            check_iql_claims(name, config, *made)
    folders = {path.name for path in make.HERE.iterdir() if (path / "config.json").exists()}
    require(folders == make.FOLDERS.keys(), f"folders and table differ: {folders ^ make.FOLDERS.keys()}")
    print(f"{len(folders)} folders are as made, and gradients agree with differences, {monotonic() - start:.0f} s")
