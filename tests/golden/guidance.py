"""The weight of QUAD's guidance, λ (Eq. 24) or what a control has in its place, and what is measured of it."""

import numpy as np

from networks import single

QUANTILES = 10, 50, 90
FIFTHS = 5


def random_state(agent, rng):
    """With guidance `mean` λ's mean at each t, of which the first is not set yet."""
    if agent["guidance"] != "mean":
        return {}
    means = rng.uniform(0.2, 0.9, agent["diffusion_steps"])
    means[0] = -1.0
    return {"lambda_means": single(means)}


def random_inputs(agent, t, rng):
    """With guidance `mean` a t that no sample has, with `shuffled` a permutation in which no sample stays."""
    if agent["guidance"] == "mean":
        return {"t": np.where(t == agent["diffusion_steps"], 1, t)}
    if agent["guidance"] != "shuffled":
        return {}
    permutation = np.arange(len(t))
    for step in range(1, agent["diffusion_steps"] + 1):
        rows = rng.permutation(np.flatnonzero(t == step))
        permutation[rows] = np.roll(rows, 1)
    return {"permutation": permutation}


def weigh(agent, state, inputs, nu_squared, sigma_squared):
    """λ as the actor's loss has it [B], δ's share of each row's denominator [B], and what else must come out."""
    guidance, t, b = agent["guidance"], inputs["t"], len(sigma_squared)
    if guidance in ("dac", "constant"):
        return np.full(b, agent.get("lambda", 1.0)), np.zeros(b), {}
    denominator = nu_squared + sigma_squared / agent["tau"] + agent["delta"]
    weights, share_of_delta = nu_squared / denominator, agent["delta"] / denominator
    if guidance == "shuffled":
        return weights[inputs["permutation"]], share_of_delta, {}
    if guidance == "quad":
        return weights, share_of_delta, {}
    before, rate = state["lambda_means"], agent["nu_ema_rate"]
    now, exist = group_means(weights, t - 1, agent["diffusion_steps"])
    means = np.where(exist, np.where(before < 0, now, (1 - rate) * before + rate * now), before)
    return means[t - 1], share_of_delta, {"lambda_means": means}


def group_means(weights, groups, count):
    """The mean weight of each group, 0 of an empty one; and which groups are not empty."""
    rows = groups == np.arange(count)[:, None]
    return (rows * weights).sum(1) / np.maximum(rows.sum(1), 1), rows.any(1)


def measure(agent, t, weights, nu_squared, sigma_squared, gradient, error):
    """Metrics of λ [B], NaN of a fifth without a sample; and the cosine of guidance ḡ [B, a] and behavior cloning, whose error is ε_θ − ε [B, a]."""
    fifths = FIFTHS * (t - 1) // agent["diffusion_steps"]
    cosine = (gradient * error).sum(-1) / np.linalg.norm(gradient, axis=-1) / np.linalg.norm(error, axis=-1)
    out = {f"lambda_quantile_{q}": np.quantile(weights, q / 100) for q in QUANTILES}
    means, exist = group_means(weights, fifths, FIFTHS)
    means = np.where(exist, means, np.nan)
    out |= {f"lambda_fifth_{fifth + 1}": means[fifth] for fifth in range(FIFTHS)}
    return out | {
        "lambda_mean": weights.mean(),
        "lambda_above_99_share": np.mean(weights > 0.99),
        "variance_ratio": np.mean(sigma_squared) / (nu_squared + agent["delta"]),
        "guidance_cosine": cosine.mean(),
    }
