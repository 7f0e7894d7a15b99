"""Chunks on a robot: the next one is computed while the last is executed. python examples/chunks.py policy.safetensors"""

import sys
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import quad_rl


class Ahead:
    """Acts as `policy.begin(seed)`, but never waits for a chunk: ValueError if the next one is late."""

    def __init__(self, policy, seed=0):
        self.policy, self.seed, self.replan = policy, seed, policy.about["chunk"]["replan"]
        self.pool, self.coming, self.queue, self.dropped = ThreadPoolExecutor(1), None, deque(), 0
        self.seen = deque(maxlen=policy.about["chunk"]["history"])

    def chunk(self, seed, seen):
        episode = self.policy.begin(seed)
        for before in seen[:-1]:
            episode.observe(before)
        return [episode.act(seen[-1]) for _ in range(self.replan)]  # The first draws the chunk that the others execute.

    def act(self, seen):
        self.seen.append(seen)
        if self.coming is None and len(self.queue) <= self.replan // 2:
            self.coming, self.since = self.pool.submit(self.chunk, self.seed, [*self.seen]), 0
            self.seed += 1
        if self.coming and self.coming.done():
            coming, self.coming = self.coming, None
            self.queue = deque(coming.result()[self.since :])  # Without those of the steps since it was begun.
            self.dropped = max(self.dropped, self.since)
        if not self.queue:
            raise ValueError("the next chunk is late")
        self.since += 1
        return self.queue.popleft()


def loop(act, sees, hertz=30.0, steps=300):
    """Calls `act` at this rate; the milliseconds of each call, and the steps without action."""
    took, missed, due = [], 0, time.perf_counter()
    for _ in range(steps):
        seen, start = np.random.normal(size=sees), time.perf_counter()
        try:
            act(seen)
        except ValueError:
            missed += 1
        took.append(1000 * (time.perf_counter() - start))
        due = max(due + 1 / hertz, time.perf_counter())
        time.sleep(max(0.0, due - time.perf_counter()))
    return np.array(took), missed


if __name__ == "__main__":
    policy = quad_rl.Policy.load(sys.argv[1])
    ahead, size = Ahead(policy), policy.observation_size
    took, _ = loop(policy.begin(0).act, size)
    chunks = took[:: ahead.replan]
    print(f"a chunk takes {np.median(chunks):.1f} ms, at most {chunks.max():.1f}")
    took, missed = loop(ahead.act, size)
    print(f"ahead, a step takes {np.median(took):.2f} ms, at most {took.max():.2f}; {missed} of {len(took)} without action")
    print(f"dropped at most {ahead.dropped} of a chunk's {ahead.replan} actions")
