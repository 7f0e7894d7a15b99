"""One update of IQL (Kostrikov et al. 2021), equation numbers are its paper's."""

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from implicit import LARGEST_WEIGHT, RATES, SIZES, act, fast_value, value
from networks import adam_step, compiled, shape

FOLDERS = {"iql": (13, "small"), "iql-online": (62, "small")}


def make_config(variant, size):
    networks = dict.fromkeys(("actor", "critic", "value"), shape([SIZES[size]["hidden"]] * 3))
    agent = networks | {"gamma": 0.99, "expectile": 0.7, "temperature": 3.0} | RATES
    online = {"step": 2300, "online_steps": 1000} if variant == "iql-online" else {}
    return implicit.make_config("iql", size, agent) | online


def value_loss(network, states, q, expectile, activation):
    """Eq. 5."""
    u = q - value(network, states, activation)
    return jnp.mean(jnp.abs(expectile - (u < 0)) * u**2)


value_gradient = compiled(jax.value_and_grad(value_loss))


def update_value(config, state, inputs, q):
    agent, activation = config["agent"], config["agent"]["value"]["activation"]
    loss, gradients = value_gradient(state["value"], inputs["observations"], q, agent["expectile"], activation)
    return adam_step(state, "value", gradients, agent["value_learning_rate"], config["step"]) | {"value_loss": loss}


def both(config, state, inputs):
    """Eq. 5, 7 and 6."""
    return implicit.update(
        config,
        state,
        inputs,
        lambda q: update_value(config, state, inputs, q),
        lambda advantages: np.exp(config["agent"]["temperature"] * advantages),
    )


def update(config, state, inputs):
    return both(config, state, inputs)[:2]


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where they do not show both sides of the expectile and of the clip."""
    state = implicit.random_state(config, rng, SIZES[size]["spread"])
    inputs = implicit.random_inputs(config, rng, size)
    expected, q, weights = both(config, state, inputs)
    activation = config["agent"]["value"]["activation"]
    above = np.mean(q > fast_value(state["value"], inputs["observations"], activation))
    # No weight so close to the largest that rounding could take it to the other side.
    close = np.any(abs(np.log(weights / LARGEST_WEIGHT)) < 2e-3)
    if close or not 0 < above < 1 or not 0 < expected["clipped_share"] < 0.5:
        return None
    return state, inputs, expected | act(config, state, inputs)
