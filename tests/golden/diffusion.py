"""QUAD's noise predictor and its diffusion. Arrays over t have T + 1 entries, so that index t is step t; ᾱ_0 = 1."""

import math

import jax.numpy as jnp
import numpy as np

from networks import compiled, mlp

TIME_FEATURES, TIME_EMBEDDING = 16, 32


def predict_noise(actor, states, noisy_actions, t):
    """ε_θ(s, a^t, t), shapes [..., o], [..., a], [...]."""
    frequencies = jnp.exp(-jnp.arange(8) * math.log(10_000) / 7)
    angles = t[..., None] * frequencies
    features = jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], -1)
    time = mlp(actor, "time.", 2, features)
    return mlp(actor, "trunk.", 4, jnp.concatenate([states, noisy_actions, time], -1))


fast_noise = compiled(predict_noise)


def schedule(steps):
    t = np.arange(1, steps + 1)
    beta = np.concatenate([[0.0], 1 - np.exp(-0.1 / steps - 0.5 * (10 - 0.1) * (2 * t - 1) / steps**2)])
    return beta, np.cumprod(1 - beta)


def denoise(actor, states, noisy_actions, t, steps):
    """x0 and the mean of one reverse step at the whole number t, without its noise."""
    beta, alpha_bar = schedule(steps)
    epsilon = fast_noise(actor, states, noisy_actions, np.full(states.shape[:-1], t))
    x0 = (noisy_actions - math.sqrt(1 - alpha_bar[t]) * epsilon) / math.sqrt(alpha_bar[t])
    x0 = np.clip(x0, -1, 1)
    of_x0 = math.sqrt(alpha_bar[t - 1]) * float(beta[t])
    of_noisy = math.sqrt(1 - beta[t]) * float(1 - alpha_bar[t - 1])
    return x0, (of_x0 * x0 + of_noisy * noisy_actions) / float(1 - alpha_bar[t])


def sample(actor, states, noise):
    """Actions for states [n, o] with noise [T, n, samples, a]; also the states, once for each action."""
    steps = len(noise)
    beta, _ = schedule(steps)
    states = np.broadcast_to(states[:, None], noise.shape[1:-1] + states.shape[-1:])
    actions = noise[0]
    for t in range(steps, 0, -1):
        _, actions = denoise(actor, states, actions, t, steps)
        if t > 1:
            actions = actions + math.sqrt(beta[t]) * noise[steps - t + 1]
    return actions, states
