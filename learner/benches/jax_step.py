"""The gradient step in JAX, timed: what `deploy/bench.sh` sets the learner's beside.

    jax_step.py [--tuned] [--seconds S] [--serve]

The step is the one of tests/golden/make.py in float32, compiled as a whole, its noise drawn inside; it is called from
Python, and run by `lax.scan`. Tuned means: Mish with a single exponential instead of softplus and tanh, and an
allocator that keeps its memory. Prints a line of JSON for each configuration: {way: seconds per step}, medians. With
--serve it waits for names of configurations on standard input, a line each, so that others can be timed in between.
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

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "golden"))

import jax
import jax.numpy as jnp
import make
import numpy as np

jax.config.update("jax_enable_x64", False)

CONFIGURATIONS = {
    "paper, 10 samples": {"hidden": 256, "critics": 10, "batch_size": 256, "samples": 10},
    "paper, 1 sample": {"hidden": 256, "critics": 10, "batch_size": 256, "samples": 1},
    "demo": {"hidden": 128, "critics": 5, "batch_size": 256, "samples": 1},
}


def tuned_mish(x):
    e = jnp.exp(jnp.minimum(x, 20.0))
    n = e * (e + 2)
    return x * (n / (n + 2))


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def prepare(sizes):
    """The step `(state, batch, key) -> state`, and what it starts from."""
    config = make.make_config("quad", "hopper")
    config["agent"] |= sizes
    agent, o, a = config["agent"], config["observation_dim"], config["action_dim"]
    rng = np.random.default_rng(0)
    state = single(make.random_state(config, rng))
    b, steps = agent["batch_size"], agent["diffusion_steps"]
    batch = {
        "observations": rng.normal(size=(b, o)),
        "actions": rng.uniform(-1, 1, (b, a)),
        "rewards": rng.normal(size=b),
        "next_observations": rng.normal(size=(b, o)),
        "masks": np.ones(b),
    }

    def step(state, batch, key):
        next_key, t_key, epsilon_key = jax.random.split(key, 3)
        draws = {
            "next_noise": jax.random.normal(next_key, (steps, b, agent["samples"], a)),
            "t": jax.random.randint(t_key, (b,), 1, steps + 1),
            "epsilon": jax.random.normal(epsilon_key, (b, a)),
        }
        out = make.update(config, state, batch | draws)
        return {name: jnp.reshape(out[name], (1,)) if name in ("eta", "nu_squared") else out[name] for name in state}

    return step, state, single(batch)


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


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tuned", action="store_true")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each way of each configuration")
    parser.add_argument("--serve", action="store_true")
    arguments = parser.parse_args()
    if arguments.tuned:
        make.mish = tuned_mish
    names = map(str.strip, sys.stdin) if arguments.serve else CONFIGURATIONS
    for name in names:
        runs = ways(name)
        print(json.dumps({way: seconds_per_step(run, arguments.seconds) for way, run in runs.items()}), flush=True)


if __name__ == "__main__":
    main()
