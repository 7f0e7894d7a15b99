"""Evaluators for environments in Python."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time

from collections.abc import Callable, Sequence
from os import PathLike
from types import TracebackType
from typing import Any

import cloudpickle  # type: ignore[import-untyped]

from quad_rl import _quad_rl
from quad_rl._extras import library
from quad_rl._process import Worker

# Interval of checks for workers that were killed, seconds.
_CHECK_INTERVAL = 1.0
# Time for workers to deliver their scores and leave, seconds.
_LEAVE = 12.0


class Evaluators:
    """Worker processes that evaluate a learner's policies in an environment of yours, until `stop()`.

    As a context manager, it stops them at the end of the block. If they fail, it interrupts the block as Ctrl-C does, and raises
    their error:

        with quad_rl.Evaluators("my-robot", lambda seed: MyEnv(), workers=2):
            subprocess.run(["learner", "train", ...])

    Arguments are those of `quad_rl.evaluate`.
    """

    def __init__(
        self,
        name: str,
        environment: str | Callable[[int], Any],
        *,
        connect: str | Sequence[str] = "tcp/127.0.0.1:7447",
        certificates: str | PathLike[str] | None = None,
        workers: int | None = None,
        score: str | tuple[float, float] = "return",
        precision: str = "f32",
    ) -> None:
        if name in _quad_rl.simulated():
            raise ValueError(f'"{name}" is an environment that `evaluator serve` simulates; choose another name')
        if isinstance(environment, str):
            environment = _Gymnasium(environment)
        if not callable(environment):
            raise ValueError("environment must be a Gymnasium id, or a function that takes a seed and returns an environment")
        workers = len(os.sched_getaffinity(0)) if workers is None else workers
        if workers < 1:
            raise ValueError(f"workers is {workers}, but must be at least 1")
        connect = [connect] if isinstance(connect, str) else list(connect)
        serve = {"connect": connect, "certificates": certificates, "precision": precision}
        task = {"name": name, "make": environment, "score": _score(score), "seed": 0, "parent": os.getpid(), "serve": serve}
        payload = [json.dumps(sys.path, default=str).encode(), cloudpickle.dumps(task)]  # Some add a Path to it.
        self._process = os.getpid()
        self._stopping = threading.Event()
        # True in a block of the main thread, which may wait for a learner that waits for these workers.
        self._interrupts = False
        self._error: Exception | None = None
        self._workers: list[Worker] = []
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        try:
            for _ in range(workers):
                self._workers.append(Worker(payload))
            for worker in self._workers:
                worker.wait_until_ready()
        except BaseException:
            self.stop()
            raise
        self._watcher.start()

    def _watch(self) -> None:
        """Restarts workers that were killed. An error of one stops them all."""
        while not self._stopping.wait(_CHECK_INTERVAL):
            try:
                for worker in self._workers:
                    worker.revive()
            except (RuntimeError, OSError) as error:
                self._error = error
                self._stopping.set()
                if self._interrupts:
                    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    def wait(self) -> None:
        """Waits until Ctrl-C, or `stop()` in another thread, stops the workers.

        Raises RuntimeError if a worker fails.
        """
        try:
            while not self._stopping.wait(0.2):
                pass
        except KeyboardInterrupt:
            pass
        finally:
            self.stop()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Stops the workers, which deliver their scores and hand back unfinished jobs."""
        if os.getpid() != self._process:
            return  # A fork of the process that owns the workers.
        self._stopping.set()
        if self._watcher.is_alive():
            self._watcher.join()
        for worker in self._workers:
            worker.end()
        until = time.monotonic() + _LEAVE
        for worker in self._workers:
            worker.wait(until)

    def __enter__(self) -> Evaluators:
        self._interrupts = threading.current_thread() is threading.main_thread()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._interrupts = False
        self.stop()
        if self._error is not None:
            raise self._error


def evaluate(name: str, environment: str | Callable[[int], Any], **arguments: Any) -> None:
    """Evaluates learners' policies in an environment of yours until Ctrl-C: `evaluator serve` for any environment.

    name: the environment's name in the learner's run: `learner train --task own-data --env NAME`.
    environment: a Gymnasium id, or a function that takes a seed and returns an environment: an object with `reset(seed=…)`,
        which returns (observation, info), and `step(action)`, which returns (observation, reward, terminated, truncated,
        info), as in Gymnasium. The seed is the run's, the same for all episodes. Observations are flattened. Online, the
        action that a person took in place of the given one is learned from, if a step returns it as info["intervention"].
    connect: endpoint of the learner or a router, or a list of endpoints.
    certificates: folder with ca.pem, cert.pem and key.pem, for endpoints like "tls/HOST:PORT".
    workers: processes, each with one job at a time [default: one per core].
    score: "return"; or "success", 100 if the last info's "success" (or "is_success") is true, else 0; or a pair (low, high)
        of returns that score 0 and 100.
    precision: arithmetic of the policy, "f32" or "bf16".

    Each worker tries its environment first: a reset and, if it has an `action_space`, a step by the action 0. An error of the
    environment is logged, reported to the learner in one line, and counts as a failed attempt of the job. Raises ValueError for
    invalid arguments, RuntimeError if the environment cannot be made, fails this trial, or returns what Gymnasium's do not.
    """
    Evaluators(name, environment, **arguments).wait()


class _Gymnasium:
    """Makes environments by their Gymnasium id."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, _seed: int) -> Any:
        return library("gymnasium", "gymnasium").make(self.name)


def _score(score: str | tuple[float, float]) -> str | tuple[float, float]:
    if isinstance(score, str) and score in ("return", "success"):
        return score
    try:
        low, high = (float(value) for value in score)
    except (TypeError, ValueError):
        low = high = 0.0
    if not low < high:
        raise ValueError(f'score must be "return", "success" or a pair (low, high) of returns, not {score!r}')
    return low, high
