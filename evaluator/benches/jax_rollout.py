"""The evaluation loop in JAX, timed: what `deploy/bench.sh` sets the evaluator's beside.

    jax_rollout.py [--seconds S] [--serve]

As is usual, and as DAC does it: one environment, and for each of its steps one call of a compiled function that draws
ten candidates and returns the one that the critics like best. Networks of the paper's sizes from tests/golden,
float32, weights random. Prints a line of JSON: seconds per environment step, as a median. With --serve it waits for
lines on standard input, and prints one for each.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

for folder in "tests/golden", "algorithms/benches":
    sys.path.insert(0, str(Path(__file__).parents[2] / folder))

import diffusion
import gymnasium
import jax
import jax.numpy as jnp
import networks
import numpy as np
import quad
from jax_step import single, traced  # also has JAX compute in float32 and optimize


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--serve", action="store_true")
    arguments = parser.parse_args()

    config = quad.make_config("quad", "hopper")
    agent, a = config["agent"], config["action_dim"]
    steps, candidates = agent["diffusion_steps"], agent["candidates"]
    state = quad.random_state(config, np.random.default_rng(0))
    actor, critics = single((state["target_actor"], state["target_critic"]))

    @jax.jit
    def act(actor, critics, observation, key):
        noise = jax.random.normal(key, (steps, 1, candidates, a))
        actions, states = traced(diffusion.sample)(actor, observation[None], noise, "mish")
        return actions[0, networks.values(critics, states, actions, "mish").mean(0)[0].argmax()]

    environment, key = gymnasium.make("Hopper-v4"), jax.random.key(0)
    observation, _ = environment.reset(seed=0)
    jax.block_until_ready(act(actor, critics, observation.astype(np.float32), key))  # compiles it
    for _ in sys.stdin if arguments.serve else range(1):
        times, deadline = [], time.perf_counter() + arguments.seconds
        while not times or time.perf_counter() < deadline:
            key, now = jax.random.split(key)
            start = time.perf_counter()
            action = np.asarray(act(actor, critics, observation.astype(np.float32), now))
            observation, _, terminated, truncated, _ = environment.step(action)
            times.append(time.perf_counter() - start)
            if terminated or truncated:
                observation, _ = environment.reset()
        print(json.dumps({"seconds": statistics.median(times)}), flush=True)


if __name__ == "__main__":
    main()
