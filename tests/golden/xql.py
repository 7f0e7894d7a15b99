"""One update of XQL (Garg et al. 2023), with its extras in the variant `xql-extras`."""

import jax
import jax.numpy as jnp
import numpy as np

import implicit
from implicit import LARGEST_WEIGHT, RATES, SIZES, act, fast_value, least, value
from networks import adam_step, compiled, fast_values, single, values

FOLDERS = {"xql": (16, "small"), "xql-extras": (17, "small")}
VARIANTS = {
    "xql": {"actor_rate_decays": True, "random_actions": 0, "value_noise": 0.0, "value_steps": 1},
    "xql-extras": {"actor_rate_decays": False, "random_actions": 1, "value_noise": 0.1, "value_steps": 2},
}
LARGEST_NOISE = 0.5


def make_config(variant, size):
    agent = {
        "gamma": 0.99,
        "beta": 0.6,
        "largest_exponent": 3.0,
        "temperature": 3.0,
        "huber": 1.5,
    }
    return implicit.make_config("xql", size, implicit.value_networks(size) | agent | RATES | VARIANTS[variant])


def value_loss(network, states, q, beta, largest_exponent, activation):
    """Gumbel regression, divided by the exponential of the batch's largest exponent, or of −1."""
    z = jnp.minimum((q - value(network, states, activation)) / beta, largest_exponent)
    largest = jax.lax.stop_gradient(jnp.maximum(z.max(), -1))
    return jnp.mean(jnp.exp(z - largest) - z * jnp.exp(-largest) - jnp.exp(-largest))


def huber_loss(critics, states, actions, targets, limit, activation):
    """Summed over the critics."""
    error = abs(values(critics, states, actions, activation) - targets)
    return jnp.mean(jnp.sum(jnp.where(error <= limit, error**2 / 2, limit * (error - limit / 2)), 0))


value_gradient = compiled(jax.value_and_grad(value_loss))
huber_gradient = compiled(jax.value_and_grad(huber_loss))


def for_value(config, state, inputs):
    """The states and their target Q that V is fitted to: more of them, and of other actions, with the extras."""
    agent, s, a = config["agent"], inputs["observations"], inputs["actions"]
    if agent["value_noise"] > 0:
        noise = np.clip(agent["value_noise"] * inputs["value_noise"], -LARGEST_NOISE, LARGEST_NOISE)
        a = np.clip(a + noise, -1, 1)
    if agent["random_actions"] > 0:
        a = np.concatenate([a, inputs["random_actions"]])
        s = np.concatenate([s, np.repeat(s, agent["random_actions"], 0)])
    return s, least(state["target_critic"], s, a, config)


def both(config, state, inputs):
    agent = config["agent"]

    def update_value(_):
        states, q = for_value(config, state, inputs)
        moved, steps = state, agent["value_steps"]
        for i in range(steps):
            arguments = states, q, agent["beta"], agent["largest_exponent"], agent["value"]["activation"]
            loss, gradients = value_gradient(moved["value"], *arguments)
            moved = adam_step(moved, "value", gradients, agent["value_learning_rate"], config["step"] * steps + i)
        return moved | {"value_loss": loss}

    def critic_gradient(critics, states, actions, targets, activation):
        return huber_gradient(critics, states, actions, targets, agent["huber"], activation)

    def weigh(advantages):
        return np.exp(agent["temperature"] * advantages)

    return implicit.update(config, state, inputs, update_value, weigh, critic_gradient)


def update(config, state, inputs):
    return both(config, state, inputs)[:2]


def draw(config, variant, size, rng):
    """A state, inputs and what comes out; None where they do not show both sides of what is clipped."""
    agent, b, a = config["agent"], config["batch_size"], config["action_dim"]
    state = implicit.random_state(config, rng, SIZES[size]["spread"])
    inputs = implicit.random_inputs(config, rng, size)
    if variant == "xql-extras":
        inputs["random_actions"] = single(rng.uniform(-1, 1, (agent["random_actions"] * b, a)))
        inputs["value_noise"] = single(rng.normal(size=(b, a)))
        # One that is clipped: the standard normal hardly ever gets there.
        inputs["value_noise"][0, 0] = 6.0
    expected, q, weights = both(config, state, inputs)
    states, q = for_value(config, state, inputs)
    z = (q - fast_value(state["value"], states, agent["value"]["activation"])) / agent["beta"]
    pairs = inputs["observations"], inputs["actions"], agent["critic"]["activation"]
    far = np.mean(abs(fast_values(state["critic"], *pairs) - expected["targets"]) > agent["huber"])
    # No weight so close to the largest that rounding could take it to the other side.
    close = np.any(abs(np.log(weights / LARGEST_WEIGHT)) < 2e-3)
    shares = np.mean(z > agent["largest_exponent"]), far, expected["clipped_share"]
    if close or not all(0 < share < 0.6 for share in shares):
        return None
    return state, inputs, expected | act(config, state, inputs)
