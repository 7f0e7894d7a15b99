"""Gradient steps in JAX, timed: what `deploy/bench.sh` sets the learner's beside.

    jax_step.py [--tuned] [--seconds S] [--serve] [NAME ...]
    jax_step.py --names
    jax_step.py --check [FOLDER ...]

A step is an algorithm's whole `update` in tests/golden, with JAX in NumPy's place, compiled as one function in float32;
it is called from Python, and run by `lax.scan`. Sizes and values are those of presets/; noise and chunks, as long actions, are
among the inputs.
Tuned means: Mish with a single exponential instead of softplus and tanh, and an allocator that keeps its memory.
Prints a line of JSON for each NAME: {way: seconds per step}, medians. With --serve it waits for names on standard
input, a line each, so that others can be timed in between. --names prints those of all algorithms. --check compares one
step, with either Mish, with the golden folders (tests/golden/README.md).
"""

import argparse
import functools
import inspect
import json
import os
import statistics
import sys
import time
import tomllib
from fnmatch import fnmatchcase
from pathlib import Path

# Otherwise large arrays are given back to the system, and faulted in again at every step. Read when a process starts.
MALLOC = {
    "MALLOC_MMAP_THRESHOLD_": "4294967296",
    "MALLOC_TRIM_THRESHOLD_": "8589934592",
    "MALLOC_TOP_PAD_": "268435456",
}
if "--tuned" in sys.argv and not os.environ.keys() >= MALLOC.keys():
    os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | MALLOC)

ROOT = Path(__file__).parents[2]
GOLDEN = ROOT / "tests" / "golden"
sys.path.insert(0, str(GOLDEN))

import jax
import jax.numpy as jnp
import networks
import numpy as np
from safetensors.numpy import load_file

# The golden scripts want neither float32, nor a compiler that takes its time, nor one function of many.
jax.config.update("jax_enable_x64", False)
jax.config.update("jax_disable_most_optimizations", False)
networks.compiled, networks.fast_values = lambda function: function, networks.values

import implicit
import make

MODULES = [m for m in list(sys.modules.values()) if Path(getattr(m, "__file__", None) or "").parent == GOLDEN]
ALGORITHMS = {m.make_config(variant, "small")["algorithm"]: m for variant, m in make.ALGORITHMS.items()}
# As in algorithms/benches/update.rs: Hopper, and what is measured beside each algorithm with its values for TASK.
OBSERVATION, ACTION = 11, 3
TASK = "hopper-medium-v2"
CONFIGURATIONS = {
    "paper, 10 samples": ("quad", "hopper-medium-replay-v2", {"samples": 10}),
    "paper, 1 sample": ("quad", "hopper-medium-replay-v2", {"samples": 1}),
    "demo": ("quad", "hopper-demo", {"samples": 1}),
    "demo, IQL": ("iql", "hopper-demo", {}),
    "qc-fql": ("fql", TASK, {"chunk": 5}),
}


def tuned_mish(x):
    e = jnp.exp(jnp.minimum(x, 20.0))
    n = e * (e + 2)
    return x * (n / (n + 2))


def single(tree):
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.int32 if x.dtype.kind == "i" else jnp.float32), tree)


def traced(function):
    """The function of a golden script, with JAX in the place of its NumPy and math."""

    def run(*arguments):
        kept = [(m, name, getattr(m, name)) for m in MODULES for name in ("np", "math") if hasattr(m, name)]
        try:
            for module, name, _ in kept:
                setattr(module, name, jnp)
            return function(*arguments)
        finally:
            for module, name, library in kept:
                setattr(module, name, library)

    return run


def outcome(config, state, inputs):
    """All that an update gives."""
    out = traced(ALGORITHMS[config["algorithm"]].update)(config, state, inputs)
    return out[0] if isinstance(out, tuple) else out


def step(config, state, inputs):
    """The state after a step, and the numbers that are measured beside it."""
    out = outcome(config, state, inputs)
    measured = {name: x for name, x in out.items() if name not in state and jnp.ndim(x) == 0}
    return jax.tree.map(lambda x, new: jnp.reshape(new, x.shape), state, {n: out.get(n, state[n]) for n in state}), measured


# The configurations to time.


def merge(below, changes):
    """Tables key by key, anything else in place of what was there."""
    for key, change in changes.items():
        below[key] = merge(below.get(key, {}), change) if isinstance(change, dict) else change
    return below


def values(algorithm, task):
    """An algorithm's values for a task, as the learner reads them."""
    table = tomllib.loads((ROOT / "presets" / f"{algorithm}.toml").read_text())
    fitting = [pattern for pattern in table.get("for", {}) if fnmatchcase(task, pattern)]
    for pattern in sorted(fitting, key=lambda pattern: len(pattern.replace("*", ""))):
        table = merge(table, table["for"][pattern])
    for network in table["agent"].values():
        if isinstance(network, dict) and "hidden" in network:
            network.setdefault("norm", False)
    return table


def phases(algorithm):
    """The shares of the phases in which the algorithm trains networks, one if it has none."""
    preset = values(algorithm, TASK)
    if updates := preset["agent"].get("value_updates"):
        return [updates, preset["steps"] - updates]
    shares = preset["agent"].get("phases", {"all": 1})
    return [share for name, share in shares.items() if share > 0 and name != "planning"]


def names():
    """{name: (algorithm, task, changes, the phase's number)} of all algorithms, as algorithms/benches/update.rs has them."""
    found = {name: (*which, 0) for name, which in CONFIGURATIONS.items()}
    for algorithm in [name for name in ALGORITHMS if name not in ("quad", "fqe")]:  # fqe trains no policy, and has no preset
        count = len(phases(algorithm))
        for i in range(count):
            found[algorithm if count == 1 else f"{algorithm}, phase {i + 1}"] = (algorithm, TASK, {}, i)
    return found


def configure(algorithm, task, changes, phase):
    """A configuration in the middle of a phase, as the golden scripts have them."""
    preset, shares = values(algorithm, task), phases(algorithm)
    middle = (sum(shares[:phase]) + shares[phase] / 2) / sum(shares)
    given = {"algorithm": algorithm, "batch_size": preset["batch_size"], "total_steps": preset["steps"], "adam": networks.ADAM}
    agent = preset["agent"] | changes
    dims = {"observation_dim": OBSERVATION * agent.pop("history", 1), "action_dim": ACTION * agent.pop("chunk", 1)}
    return dims | given | {"step": int(middle * preset["steps"]) + 1, "agent": agent}


def prepare(name):
    """The steps `(state, inputs) -> (state, measured)` in which all networks move, and both of them, inputs for each step."""
    config = configure(*names()[name])
    count = config["agent"].get("actor_every", 1)
    module, rng = ALGORITHMS[config["algorithm"]], np.random.default_rng(0)
    few = {} if config["algorithm"] == "qc" else {"candidates": 2}  # of others an update draws none
    given = {"config": config | {"agent": config["agent"] | few}, "rng": rng, "size": "hopper", "spread": 1.0}

    def drawn(function):
        function = getattr(module, function, None) or getattr(implicit, function)
        return function(*(given[name] for name in inspect.signature(function).parameters))

    given["state"] = drawn("random_state")
    inputs = drawn("random_inputs")

    def steps(state, inputs):
        for i, of_step in enumerate(inputs):
            state, measured = step(config | {"step": config["step"] + i}, state, of_step)
        return state, measured

    return steps, single(given["state"]), [single(inputs)] * count


# Timing.


def called(step, state, inputs):
    """A function that makes the steps five times, by five calls."""
    compiled = jax.jit(step, donate_argnums=0)
    state = jax.tree.map(jnp.copy, state)

    def run():
        nonlocal state
        for _ in range(5):
            state, measured = compiled(state, inputs)
        jax.block_until_ready((state, measured))

    return run


def scanned(step, state, inputs):
    """A function that makes the steps five times, by one call."""

    @functools.partial(jax.jit, donate_argnums=0)
    def steps(state, inputs):
        return jax.lax.scan(step, state, inputs)

    # Each step has inputs of its own: what depends on the same ones would be computed once.
    inputs = jax.tree.map(lambda x: jnp.stack([x] * 5), inputs)
    state = jax.tree.map(jnp.copy, state)

    def run():
        nonlocal state
        state, _ = jax.block_until_ready(steps(state, inputs))

    return run


def seconds_per_step(run, budget):
    """Median over calls of `run`, which makes so many steps."""
    run, steps = run
    times = []
    deadline = time.perf_counter() + budget
    while len(times) < 3 or time.perf_counter() < deadline:
        start = time.perf_counter()
        run()
        times.append((time.perf_counter() - start) / steps)
    return statistics.median(times)


@functools.cache
def ways(name):
    """{way: function that makes steps, and how many}, compiled."""
    prepared = prepare(name)
    runs = {way.__name__: way(*prepared) for way in (called, scanned)}
    for run in runs.values():
        run()
    return {way: (run, 5 * len(prepared[2])) for way, run in runs.items()}


def check(folders):
    """One step against these golden folders, by the measure and the bound of tests/golden/README.md."""
    worst = 0.0
    jax.config.update("jax_disable_most_optimizations", True)  # compiling takes longer than running
    for name, mish in [(name, networks.mish) for name in folders] + [("quad", tuned_mish)]:
        networks.ACTIVATIONS["mish"] = mish
        folder = GOLDEN / name
        config = json.loads((folder / "config.json").read_text())
        start, inputs, expected = (load_file(folder / f"{x}.safetensors") for x in ("state", "inputs", "expected"))
        state = {}
        for tensor, x in start.items():
            # `eta`, or network and tensor: `adam_m.critic` and `0.kernel`.
            parts = tensor.split(".")
            network = ".".join(parts[: 2 if tensor.startswith("adam_") else 1])
            inner = tensor.removeprefix(network).removeprefix(".")
            if inner:
                state.setdefault(network, {})[inner] = x
            else:
                state[network] = x
        found = make.flatten(jax.jit(functools.partial(outcome, config))(single(state), single(inputs)))
        if missing := start.keys() - found.keys():
            raise SystemExit(f"check failed: {name} lacks {missing}")
        for tensor in found.keys() & expected.keys():
            difference = make.distance(found[tensor], expected[tensor])
            if not difference < 1e-4:
                raise SystemExit(f"check failed: {tensor} of {name} is off by {difference:.1e}")
            worst = max(worst, difference)
    print(f"jax_step: the steps do what the golden folders ask for, to {worst:.0e}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tuned", action="store_true")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each way of each configuration")
    parser.add_argument("--serve", action="store_true")
    parser.add_argument("--names", action="store_true")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("name", nargs="*", help="what to time; without one, everything")
    arguments = parser.parse_args()
    if arguments.check:
        # JAX cannot compile planning, which trains no network, and windows, which depend on the data.
        left_out = ("-planning", "-chunks", "qc")
        return check(arguments.name or [name for name in make.FOLDERS if not name.endswith(left_out)])
    if arguments.names:
        return print("\n".join(names()))
    if arguments.tuned:
        networks.ACTIVATIONS["mish"] = tuned_mish
    for name in map(str.strip, sys.stdin) if arguments.serve else arguments.name or names():
        runs = ways(name)
        print(json.dumps({way: seconds_per_step(run, arguments.seconds) for way, run in runs.items()}), flush=True)


if __name__ == "__main__":
    main()
