"""Rows per second that a Reverb server takes in from 1 and 8 writers, each row of Hopper's size: 11 observed numbers, 3 of an action.

    pip install dm-reverb==0.14.0 tensorflow-cpu==2.14.1 'numpy<2' 'setuptools<81'    # Python 3.11 at most
    python deploy/bench/experience.py

The learner's rows per second, in the same setting:

    cargo run --release -p quad-tests --example load -- 8 online
"""

import multiprocessing
import time

import numpy as np
import reverb

STEPS = 1000  # of an episode
ROWS = 100_000


def serve(port):
    limiter = reverb.rate_limiters.MinSize(1)
    sampler, remover = reverb.selectors.Uniform(), reverb.selectors.Fifo()
    table = reverb.Table("replay", sampler=sampler, remover=remover, max_size=10**7, rate_limiter=limiter)
    reverb.Server([table], port=port).wait()


def write(port):
    """Transitions, as Acme's adders write them: two steps each."""
    row = {"observation": np.full(11, 0.1, np.float32), "action": np.full(3, 0.1, np.float32), "reward": np.float32(2)}
    with reverb.Client(f"localhost:{port}").trajectory_writer(num_keep_alive_refs=2) as writer:
        while True:
            for step in range(STEPS + 1):
                writer.append(row)
                if step > 0:
                    trajectory = {name: writer.history[name][-2:] for name in row}
                    writer.create_item("replay", priority=1.0, trajectory=trajectory)
            writer.end_episode()


def main():
    spawn = multiprocessing.get_context("spawn")
    for writers, port in (1, 7501), (8, 7502):
        processes = [spawn.Process(target=serve, args=(port,), daemon=True)]
        processes += [spawn.Process(target=write, args=(port,), daemon=True) for _ in range(writers)]
        [process.start() for process in processes]
        client = reverb.Client(f"localhost:{port}")

        def wait_for(rows):
            while (size := client.server_info()["replay"].current_size) < rows:
                time.sleep(0.01)
            return size, time.monotonic()

        (first, begin), (last, end) = wait_for(10_000), wait_for(10_000 + ROWS)
        print(f"{writers} writers: {(last - first) / (end - begin):.0f} rows/s", flush=True)
        [process.kill() for process in processes]


if __name__ == "__main__":
    main()
