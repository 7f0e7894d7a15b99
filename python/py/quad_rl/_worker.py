"""One process of `quad_rl.evaluate`: it steps environments for a learner, until SIGTERM or the end of its parent.

`quad_rl.evaluate` starts it as `python -m quad_rl._worker`, and writes a task to its standard input. The worker
answers with a line of JSON: the sizes of the environment, which it has tried for a step, or an error. A later line is an error, too.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import IO, Any

import cloudpickle  # type: ignore[import-untyped]
import numpy as np

from quad_rl import _quad_rl
from quad_rl._environment import EnvironmentFailed, WrappedEnvironment, call, draw_from


class Factory:
    """Makes environments, and reuses free ones, because making one may take seconds."""

    def __init__(self, make: Callable[[int], Any], score: str | tuple[float, float], give_up: Callable[[Exception], None]) -> None:
        self.make_environment = make
        self.score = score
        self.give_up = give_up
        self.seed: int | None = None
        self.free: list[WrappedEnvironment] = []

    def make(self, seed: int) -> WrappedEnvironment:
        if seed != self.seed:
            self.close()
            self.seed = seed
        if self.free:
            return self.free.pop()
        draw_from(np.random.MT19937(), seed % 2**31)
        return WrappedEnvironment(call(self.make_environment, seed), self.score)

    def release(self, wrapped: WrappedEnvironment) -> None:
        if wrapped.unusable:
            self.give_up(wrapped.unusable)
        if wrapped.broken:
            _close(wrapped)
        else:
            self.free.append(wrapped)

    def close(self) -> None:
        while self.free:
            _close(self.free.pop())


def _close(wrapped: WrappedEnvironment) -> None:
    if hasattr(wrapped.environment, "close"):
        try:
            call(wrapped.environment.close)
        except EnvironmentFailed:
            pass  # It is in the log.


def _read(stream: IO[bytes]) -> bytes:
    length = int.from_bytes(stream.read(8), "little")
    return stream.read(length)


def _end_with(parent: int) -> None:
    """Sends SIGTERM to this process when its parent is gone. A pipe would not show it: other children may hold it open."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)


def main() -> None:
    # Keeps the user's prints out of the answer.
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)

    def reply(**message: Any) -> None:
        print(json.dumps(message), file=answer, flush=True)

    paths, pickled = _read(sys.stdin.buffer), _read(sys.stdin.buffer)
    sys.path[:] = json.loads(paths)
    try:
        task = cloudpickle.loads(pickled)
        threading.Thread(target=_end_with, args=(task["parent"],), daemon=True).start()

        def give_up(error: Exception) -> None:
            reply(error=f'the environment "{task["name"]}": {error}')
            os.kill(os.getpid(), signal.SIGTERM)  # Hands the job back.

        factory = Factory(task["make"], task["score"], give_up)
        made = factory.make(task.pop("seed"))
        made.try_out()
        sizes = made.sizes()
        factory.release(made)
        reply(sizes=sizes)
        _quad_rl.serve_environment(task["name"], factory, sizes=sizes, **task["serve"])
        factory.close()
    except Exception as error:
        if isinstance(error, EnvironmentFailed):
            error = EnvironmentFailed(f'the environment "{task["name"]}": {error}')
        else:
            traceback.print_exc(file=sys.stderr)
        reply(error=f"{error}")
        sys.stderr.flush()
        os._exit(1)
    # Does not wait for threads of the user or of a simulator.
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
