"""The noise predictor, and QUAD's diffusion. Arrays over t have T + 1 entries, so that index t is step t; ᾱ_0 = 1."""

import math

import jax.numpy as jnp
import numpy as np

from networks import compiled, mlp, random_network, shape

TIME_FEATURES, TIME_EMBEDDING = 16, 32


def predict_noise(actor, states, noisy_actions, t, activation):
    """ε_θ(s, a^t, t), shapes [..., o], [..., a], [...]."""
    frequencies = jnp.exp(-jnp.arange(8) * math.log(10_000) / 7)
    angles = t[..., None] * frequencies
    features = jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], -1)
    time = mlp(actor, "time.", "mish", features)
    return mlp(actor, "trunk.", activation, jnp.concatenate([states, noisy_actions, time], -1))


fast_noise = compiled(predict_noise)


def random_predictor(rng, observation_dim, action_dim, trunk):
    time = random_network(rng, TIME_FEATURES, shape([TIME_EMBEDDING]), TIME_EMBEDDING, prefix="time.")
    inputs = observation_dim + action_dim + TIME_EMBEDDING
    return time | random_network(rng, inputs, trunk, action_dim, prefix="trunk.")


def schedule(steps):
    t = np.arange(1, steps + 1)
    beta = np.concatenate([np.zeros(1), 1 - np.exp(-0.1 / steps - 0.5 * (10 - 0.1) * (2 * t - 1) / steps**2)])
    return beta, np.cumprod(1 - beta)


def clean(noisy_actions, epsilon, alpha_bar):
    """x0 by the predicted noise, clipped."""
    return np.clip((noisy_actions - np.sqrt(1 - alpha_bar) * epsilon) / np.sqrt(alpha_bar), -1, 1)


def denoise(actor, states, noisy_actions, t, steps, activation, pull=None):
    """x0 and the mean of one reverse step at the whole number t, without its noise. A pull, of states and x0, is added to
    the score.
    """
    beta, alpha_bar = schedule(steps)
    epsilon = fast_noise(actor, states, noisy_actions, np.full(states.shape[:-1], t), activation)
    x0 = clean(noisy_actions, epsilon, alpha_bar[t])
    if pull:
        score = -epsilon / math.sqrt(1 - alpha_bar[t]) + pull(states, x0)
        x0 = clean(noisy_actions, -score * math.sqrt(1 - alpha_bar[t]), alpha_bar[t])
    of_x0 = math.sqrt(alpha_bar[t - 1]) * beta[t]
    of_noisy = math.sqrt(1 - beta[t]) * (1 - alpha_bar[t - 1])
    return x0, (of_x0 * x0 + of_noisy * noisy_actions) / (1 - alpha_bar[t])


def repeated(states, noise):
    """States [n, o], once for each sample that noise [T, n, samples, a] makes."""
    return np.broadcast_to(states[:, None], noise.shape[1:-1] + states.shape[-1:])


def sample(actor, states, noise, activation, pull=None):
    """Actions for states [n, o] with noise [T, n, samples, a]; also the states, once for each action."""
    steps = len(noise)
    beta, _ = schedule(steps)
    states = repeated(states, noise)
    actions = noise[0]
    for t in range(steps, 0, -1):
        _, actions = denoise(actor, states, actions, t, steps, activation, pull)
        if t > 1:
            actions = actions + math.sqrt(beta[t]) * noise[steps - t + 1]
    return actions, states
