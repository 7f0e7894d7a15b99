"""One update of IVR (Xu et al. 2023): SQL with the divergence `sparse`, EQL with `exponential`."""

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from implicit import LARGEST_WEIGHT, RATES, SIZES, act, fast_value, value
from networks import adam_step, compiled

LARGEST_EXPONENT = 5.0
# SQL's weights are advantages, so some must exceed the largest weight: its values are many times as large.
FOLDERS = {"sql": (14, "small"), "eql": (15, "small")}
VARIANTS = {
    "sql": {"divergence": "sparse", "alpha": {"sparse": 40.0, "exponential": 1.5}, "spread": 50},
    "eql": {"divergence": "exponential", "alpha": {"sparse": 40.0, "exponential": 1.5}, "spread": 1.5},
}


def make_config(variant, size):
    divergence = {name: x for name, x in VARIANTS[variant].items() if name != "spread"}
    return implicit.make_config("ivr", size, implicit.value_networks(size) | {"gamma": 0.99} | divergence | RATES)


def sparse_loss(network, states, q, alpha, activation):
    v = value(network, states, activation)
    z = (q - v) / (2 * alpha) + 1
    return jnp.mean((z > 0) * z**2 + v / alpha)


def exponential_loss(network, states, q, alpha, activation):
    """Divided by the exponential of the batch's largest exponent, or of −1."""
    v = value(network, states, activation)
    z = jnp.minimum((q - v) / alpha, LARGEST_EXPONENT)
    largest = jax.lax.stop_gradient(jnp.maximum(z.max(), -1))
    return jnp.mean(jnp.exp(z - largest) + jnp.exp(-largest) * v / alpha)


GRADIENTS = {
    "sparse": compiled(jax.value_and_grad(sparse_loss)),
    "exponential": compiled(jax.value_and_grad(exponential_loss)),
}


def both(config, state, inputs):
    agent, s = config["agent"], inputs["observations"]
    divergence, alpha = agent["divergence"], agent["alpha"][agent["divergence"]]

    def update_value(q):
        loss, gradients = GRADIENTS[divergence](state["value"], s, q, alpha, agent["value"]["activation"])
        moved = adam_step(state, "value", gradients, agent["value_learning_rate"], config["step"])
        return moved | {"value_loss": loss}

    def weigh(advantages):
        return advantages if divergence == "sparse" else np.exp(10 * advantages / alpha)

    return implicit.update(config, state, inputs, update_value, weigh)


def update(config, state, inputs):
    return both(config, state, inputs)[:2]


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where they do not show all sides of what is clipped."""
    state = implicit.random_state(config, rng, VARIANTS[variant]["spread"] * SIZES[size]["spread"])
    inputs = implicit.random_inputs(config, rng, size)
    expected, q, weights = both(config, state, inputs)
    agent = config["agent"]
    v = fast_value(state["value"], inputs["observations"], agent["value"]["activation"])
    z = (q - v) / agent["alpha"][agent["divergence"]]
    below = np.mean(z < -2) if variant == "sql" else np.mean(z > LARGEST_EXPONENT)
    # No weight so close to the largest that rounding could take it to the other side.
    close = np.any(abs(np.log(np.abs(weights) / LARGEST_WEIGHT)) < 2e-3)
    few = np.sum((weights > 0.05) & (weights < LARGEST_WEIGHT)) < 2
    if close or few or not 0 < below < 0.8 or not 0 < expected["clipped_share"] < 0.8:
        return None
    return state, inputs, expected | act(config, state, inputs)
