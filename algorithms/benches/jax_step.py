"""The gradient step in JAX, timed: what `deploy/bench.sh` sets the learner's beside.

    jax_step.py [--tuned] [--seconds S] [--serve]
    jax_step.py --check

The step is QUAD's, as tests/golden/quad.py has it, but in float32 and compiled as a whole, its noise drawn inside; it
is called from Python, and run by `lax.scan`. Tuned means: Mish with a single exponential instead of softplus and tanh,
and an allocator that keeps its memory. Prints a line of JSON for each configuration: {way: seconds per step}, medians.
With --serve it waits for names of configurations on standard input, a line each, so that others can be timed in
between. --check compares one step, with either Mish, with golden folders (tests/golden/README.md).
"""

import argparse
import functools
import json
import os
import statistics
import sys
import time
from pathlib import Path

# Otherwise large arrays are given back to the system, and faulted in again at every step. Read when a process starts.
MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": "4294967296",
    "MALLOC_TRIM_THRESHOLD_": "8589934592",
    "MALLOC_TOP_PAD_": "268435456",
}
if "--tuned" in sys.argv and not os.environ.keys() >= MALLOC.keys():
    os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | MALLOC)

GOLDEN = Path(__file__).parents[2] / "tests" / "golden"
sys.path.insert(0, str(GOLDEN))

import diffusion
import jax
import jax.numpy as jnp
import networks
import numpy as np
import quad
from make import distance, flatten
from safetensors.numpy import load_file

# The golden script wants neither float32 nor a compiler that takes its time.
jax.config.update("jax_enable_x64", False)
jax.config.update("jax_disable_most_optimizations", False)

# As in algorithms/benches/update.rs. The demonstration's η is constant, so its actor predicts once, not twice.
CONFIGURATIONS = {
    "paper, 10 samples": {"critics": 10, "samples": 10},
    "paper, 1 sample": {"critics": 10, "samples": 1},
    "demo": {name: networks.shape([128] * 3) for name in ("actor", "critic")}
    | {"critics": 5, "samples": 1, "eta": {"initial": 1.0}},
}


def tuned_mish(x):
    e = jnp.exp(jnp.minimum(x, 20.0))
    n = e * (e + 2)
    return x * (n / (n + 2))


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


# One update, as quad.update has it, in functions that JAX can compile.


def sample(actor, states, noise):
    """Actions for states [n, o] with noise [T, n, samples, a]; also the states, once for each action."""
    steps = len(noise)
    beta, alpha_bar = diffusion.schedule(steps)
    states = jnp.broadcast_to(states[:, None], noise.shape[1:-1] + states.shape[-1:])
    actions = noise[0]
    for t in range(steps, 0, -1):
        epsilon = diffusion.predict_noise(actor, states, actions, jnp.full(states.shape[:-1], t), "mish")
        x0 = jnp.clip((actions - np.sqrt(1 - alpha_bar[t]) * epsilon) / np.sqrt(alpha_bar[t]), -1, 1)
        of_x0 = np.sqrt(alpha_bar[t - 1]) * beta[t] / (1 - alpha_bar[t])
        of_noisy = np.sqrt(1 - beta[t]) * (1 - alpha_bar[t - 1]) / (1 - alpha_bar[t])
        actions = of_x0 * x0 + of_noisy * actions
        if t > 1:
            actions += np.sqrt(beta[t]) * noise[steps - t + 1]
    return actions, states


def action_gradients(critics, states, actions):
    """∂Q_k/∂a for each critic and row, [K, B, a]."""

    def total(critic, actions):
        return networks.mlp(critic, "", "mish", jnp.concatenate([states, actions], -1)).sum()

    return jax.vmap(jax.grad(total, 1), (0, None))(critics, actions)


def descend(config, state, name, gradients):
    """What clipping and Adam make of the network called name and of its moments."""
    agent, done, (beta1, beta2) = config["agent"], state["step"] + 1, (networks.ADAM["beta1"], networks.ADAM["beta2"])
    norm = jnp.sqrt(sum(jnp.sum(g**2) for g in gradients.values()))
    scale = jnp.minimum(1.0, agent["gradient_clip"] / norm)
    decay = 0.5 * (1 + jnp.cos(jnp.pi * state["step"] / config["total_steps"]))
    rate = agent[f"{name}_learning_rate"] * decay / (1 - beta1**done)
    m, v = state[f"adam_m.{name}"], state[f"adam_v.{name}"]
    m = {n: beta1 * m[n] + (1 - beta1) * scale * g for n, g in gradients.items()}
    v = {n: beta2 * v[n] + (1 - beta2) * (scale * g) ** 2 for n, g in gradients.items()}
    moved = {
        n: x - rate * m[n] / (jnp.sqrt(v[n] / (1 - beta2**done)) + networks.ADAM["epsilon"])
        for n, x in state[name].items()
    }
    return {name: moved, f"adam_m.{name}": m, f"adam_v.{name}": v}


def guide(agent, state, inputs, noisy, target_critic):
    """λ [B, 1], ḡ [B, a] and ν̂², Eq. 10 and 21-24."""
    s, rate, nu_squared = inputs["observations"], agent["nu_ema_rate"], state["nu_squared"]
    q_scale = jnp.abs(networks.values(target_critic, s, inputs["actions"], "mish")).mean() + 1e-6
    g = action_gradients(target_critic, s, noisy) / q_scale
    predicted = diffusion.predict_noise(state["actor"], s, noisy, inputs["t"], "mish")
    u = predicted / (jnp.linalg.norm(predicted, axis=-1, keepdims=True) + 1e-8)
    alignment = (u * g).sum(-1)  # [K, B]
    batch_nu = alignment.mean(0).var()
    nu_squared = jnp.where(nu_squared < 0, batch_nu, (1 - rate) * nu_squared + rate * batch_nu)
    weights = nu_squared / (nu_squared + alignment.var(0) / agent["tau"] + agent["delta"])
    return weights[:, None], g.mean(0), nu_squared


def step(config, state, inputs):
    """What becomes of the state, with guidance `quad` and means over samples."""
    agent = config["agent"]
    alpha_bar = jnp.asarray(diffusion.schedule(agent["diffusion_steps"])[1], jnp.float32)
    s, a, t, epsilon = (inputs[name] for name in ("observations", "actions", "t", "epsilon"))

    # Critics, Eq. 20.
    next_actions, next_states = sample(state["target_actor"], inputs["next_observations"], inputs["next_noise"])
    q = networks.values(state["target_critic"], next_states, next_actions, "mish").mean(-1)  # [K, B]
    targets = inputs["rewards"] + agent["gamma"] * inputs["masks"] * (q.mean(0) - agent["rho"] * q.std(0))
    new = descend(config, state, "critic", jax.grad(quad.critic_loss)(state["critic"], s, a, targets, "mish"))
    new["target_critic"] = networks.follow(state["target_critic"], new["critic"], agent["ema_rate"])

    # Actor, Eq. 5 and 19.
    noise_level = jnp.sqrt(1 - alpha_bar[t])[:, None]
    noisy = jnp.sqrt(alpha_bar[t])[:, None] * a + noise_level * epsilon
    weights, gradient, new["nu_squared"] = guide(agent, state, inputs, noisy, new["target_critic"])
    arguments = (s, noisy, t, epsilon, state["eta"][0], weights * noise_level, gradient, "mish")
    gradients, _ = jax.grad(quad.actor_loss, has_aux=True)(state["actor"], *arguments)
    new |= descend(config, state, "actor", gradients)

    # Dual ascent on η, and the target actor.
    new["eta"] = state["eta"]
    if "threshold" in agent["eta"]:
        _, (bc, _) = quad.actor_loss(new["actor"], *arguments)
        eta = state["eta"] + agent["eta"]["rate"] * jnp.clip(bc - agent["eta"]["threshold"], -1, 1)
        new["eta"] = jnp.clip(eta, agent["eta"]["minimum"], agent["eta"]["maximum"])
    count, target = state["step"], state["target_actor"]
    new["target_actor"] = jax.lax.cond(
        (count % agent["actor_ema_every"] == 0) & (count > agent["actor_ema_start"]),
        lambda: networks.follow(target, new["actor"], agent["ema_rate"]),
        lambda: target,
    )
    return new | {"step": count + 1}


# Timing.


def prepare(sizes):
    """The step `(state, batch, key) -> state`, and what it starts from."""
    config = quad.make_config("quad", "hopper")
    config["agent"] |= sizes
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    rng = np.random.default_rng(0)
    state = single(quad.random_state(config, rng)) | {"step": jnp.int32(0)}
    b, steps = config["batch_size"], agent["diffusion_steps"]
    batch = {
        "observations": rng.normal(size=(b, o)),
        "actions": rng.uniform(-1, 1, (b, a)),
        "rewards": rng.normal(size=b),
        "next_observations": rng.normal(size=(b, o)),
        "masks": np.ones(b),
    }

    def drawn(state, batch, key):
        next_key, t_key, epsilon_key = jax.random.split(key, 3)
        draws = {
            "next_noise": jax.random.normal(next_key, (steps, b, agent["samples"], a)),
            "t": jax.random.randint(t_key, (b,), 1, steps + 1),
            "epsilon": jax.random.normal(epsilon_key, (b, a)),
        }
        return step(config, state, batch | draws)

    return drawn, state, single(batch)


def called(step, state, batch):
    """A function that makes five steps by five calls."""
    compiled, key = jax.jit(step, donate_argnums=0), jax.random.key(0)
    state = jax.tree.map(jnp.copy, state)

    def run():
        nonlocal state, key
        for _ in range(5):
            key, now = jax.random.split(key)
            state = compiled(state, batch, now)
        jax.block_until_ready(state)

    return run


def scanned(step, state, batch):
    """A function that makes five steps by one call."""

    @functools.partial(jax.jit, donate_argnums=0)
    def steps(state, batch, key):
        return jax.lax.scan(lambda state, key: (step(state, batch, key), None), state, jax.random.split(key, 5))[0]

    state = jax.tree.map(jnp.copy, state)

    def run():
        nonlocal state
        state = jax.block_until_ready(steps(state, batch, jax.random.key(0)))

    return run


def seconds_per_step(run, budget):
    """Median over calls of `run`, which makes five steps."""
    times = []
    deadline = time.perf_counter() + budget
    while len(times) < 3 or time.perf_counter() < deadline:
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) / 5)
    return statistics.median(times)


@functools.cache
def ways(name):
    """{way: function that makes five steps}, compiled."""
    prepared = prepare(CONFIGURATIONS[name])
    runs = {way.__name__: way(*prepared) for way in (called, scanned)}
    for run in runs.values():
        run()
    return runs


def check():
    """One step against golden folders, by the measure and the bound of tests/golden/README.md."""
    worst = 0.0
    # In the first, both gradients are clipped and the target actor moves; in the second it does not.
    for name, mish in ("quad", networks.mish), ("ten-critics", networks.mish), ("quad", tuned_mish):
        networks.ACTIVATIONS["mish"] = mish
        folder = GOLDEN / name
        config = json.loads((folder / "config.json").read_text())
        start, inputs, expected = (load_file(folder / f"{x}.safetensors") for x in ("state", "inputs", "expected"))
        state = {"step": jnp.int32(config["step"])}
        for tensor, x in start.items():
            # `eta`, or network and tensor: `adam_m.critic` and `0.kernel`.
            parts = tensor.split(".")
            network = ".".join(parts[: 2 if tensor.startswith("adam_") else 1])
            inner = tensor.removeprefix(network).removeprefix(".")
            if inner:
                state.setdefault(network, {})[inner] = x
            else:
                state[network] = x
        found = flatten(jax.jit(functools.partial(step, config))(state, inputs))
        for tensor in start:
            difference = distance(found[tensor], expected[tensor])
            if not difference < 1e-4:
                raise SystemExit(f"check failed: {tensor} of {name} is off by {difference:.1e}")
            worst = max(worst, difference)
    print(f"jax_step: the step does what the golden folders ask for, to {worst:.0e}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tuned", action="store_true")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each way of each configuration")
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    if arguments.check:
        return check()
    if arguments.tuned:
        networks.ACTIVATIONS["mish"] = tuned_mish
    names = map(str.strip, sys.stdin) if arguments.serve else CONFIGURATIONS
    for name in names:
        runs = ways(name)
        print(json.dumps({way: seconds_per_step(run, arguments.seconds) for way, run in runs.items()}), flush=True)


if __name__ == "__main__":
    main()
