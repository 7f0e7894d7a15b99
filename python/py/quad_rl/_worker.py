"""One process of `quad_rl.evaluate`: it steps environments for a learner, until SIGTERM or the end of its parent.

`quad_rl.evaluate` starts it as `python -m quad_rl._worker`, and writes a task to its standard input. The worker
answers with one line of JSON: the sizes of the environment, or an error.
"""

from __future__ import annotations

import inspect
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import IO, Any

import cloudpickle  # type: ignore[import-untyped]
import numpy as np
from numpy.random.mtrand import set_bit_generator
from numpy.typing import NDArray

from quad_rl import _quad_rl


class EnvironmentFailed(RuntimeError):
    """An error of the user's code, in one line, for the learner."""


def _call(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    """Calls the user's code. Logs its error in full, and raises it in one line."""
    try:
        return function(*arguments, **keywords)
    except (Exception, SystemExit) as error:
        traceback.print_exc(file=sys.stderr)
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{os.path.basename(frame.filename)}:{frame.lineno}, in {frame.name}"
        raise EnvironmentFailed(f"{type(error).__name__}: {error} ({place})") from None


def _draw_from(generator: np.random.MT19937, seed: int) -> None:
    """Makes NumPy's global functions draw from this generator, as after `np.random.seed(seed)`."""
    set_bit_generator(generator)
    np.random.seed(seed)


def _action_spaces(environment: Any) -> Iterator[Any]:
    """The action spaces of an environment and of those that it wraps."""
    while environment is not None:
        space = getattr(environment, "action_space", None)
        if hasattr(space, "seed"):
            yield space
        environment = getattr(environment, "env", None)


class WrappedEnvironment:
    """A user's environment, with flat observations and actions."""

    def __init__(self, environment: Any, score: str | tuple[float, float]) -> None:
        self.environment = environment
        self.score_rule = score
        self.generator = np.random.MT19937()
        self.info: dict[str, Any] = {}
        self.broken = False
        self.space = getattr(environment, "observation_space", None)
        try:
            parameters = list(inspect.signature(environment.reset).parameters.values())
        except ValueError:  # Of a C extension.
            parameters = []
        self.takes_options = any(it.name == "options" or it.kind is it.VAR_KEYWORD for it in parameters)
        action_space = getattr(environment, "action_space", None)
        self.action_shape = getattr(action_space, "shape", None)
        if action_space is not None and not self.action_shape:
            raise EnvironmentFailed(f"actions must be a box of numbers (gymnasium.spaces.Box), not {action_space}")
        low, high = getattr(action_space, "low", None), getattr(action_space, "high", None)
        self.bounds = None if low is None or high is None else (low, high)

    def sizes(self) -> tuple[int, int] | None:
        """Sizes of an observation and an action, if the environment has spaces."""
        if self.action_shape is None or self.space is None:
            return None
        shape = getattr(self.space, "shape", None)
        if shape is None:
            from gymnasium.spaces import flatdim

            return int(flatdim(self.space)), int(np.prod(self.action_shape))
        return int(np.prod(shape)), int(np.prod(self.action_shape))

    def _row(self, observation: Any) -> NDArray[np.float64]:
        if self.space is not None and getattr(self.space, "shape", None) is None:
            from gymnasium.spaces import flatten

            observation = flatten(self.space, observation)
        return np.ascontiguousarray(observation, dtype=np.float64).ravel()

    def _run(self, method: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        # The environments of this process share NumPy's global generator.
        set_bit_generator(self.generator)
        self.broken = True
        result = _call(method, *arguments, **keywords)
        self.broken = False
        return result

    def reset(self, seed: int, practice: bool = False) -> NDArray[np.float64]:
        # Many simulators take seeds of 32 bits at most.
        seed %= 2**31
        # Some draw from NumPy's global generator or from the action space, which Gymnasium's reset does not seed.
        _draw_from(self.generator, seed)
        for space in _action_spaces(self.environment):
            space.seed(seed)
        options = {"options": {"practice": True}} if practice and self.takes_options else {}
        observation, _ = self._run(self.environment.reset, seed=seed, **options)
        return self._row(observation)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], float, bool, bool, list[float] | None]:
        size = action.size
        if self.action_shape is not None:
            action = action.reshape(self.action_shape)
        if self.bounds is not None:
            action = np.clip(action, *self.bounds)
        observation, reward, terminated, truncated, self.info = self._run(self.environment.step, action)
        taken = self.info.get("intervention")
        return self._row(observation), float(reward), bool(terminated), bool(truncated), _intervention(taken, size)

    def score(self, episode_return: float) -> float:
        if self.score_rule == "return":
            return float(episode_return)
        if self.score_rule == "success":
            success = self.info.get("success", self.info.get("is_success"))
            if success is None:
                raise EnvironmentFailed('the last info of an episode has neither "success" nor "is_success"')
            if success not in (0, 1):
                raise EnvironmentFailed(f'the last "success" of an episode is {success}, neither true nor false')
            return 100.0 * bool(success)
        low, high = map(float, self.score_rule)
        return 100.0 * (episode_return - low) / (high - low)


def _intervention(taken: Any, size: int) -> list[float] | None:
    """The action that a person took."""
    if taken is None:
        return None
    action = np.asarray(taken, np.float32).ravel()
    if action.size != size or not np.isfinite(action).all():
        raise EnvironmentFailed(f'info["intervention"] must be {size} finite numbers, the action that was taken, not {taken!r}')
    return action.tolist()


class Factory:
    """Makes environments, and reuses free ones, because making one may take seconds."""

    def __init__(self, make: Callable[[int], Any], score: str | tuple[float, float]) -> None:
        self.make_environment = make
        self.score = score
        self.seed: int | None = None
        self.free: list[WrappedEnvironment] = []

    def make(self, seed: int) -> WrappedEnvironment:
        if seed != self.seed:
            self.close()
            self.seed = seed
        if self.free:
            return self.free.pop()
        _draw_from(np.random.MT19937(), seed % 2**31)
        return WrappedEnvironment(_call(self.make_environment, seed), self.score)

    def release(self, wrapped: WrappedEnvironment) -> None:
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
            _call(wrapped.environment.close)
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

    paths, task = _read(sys.stdin.buffer), _read(sys.stdin.buffer)
    sys.path[:] = json.loads(paths)
    try:
        task = cloudpickle.loads(task)
        threading.Thread(target=_end_with, args=(task["parent"],), daemon=True).start()
        factory = Factory(task["make"], task["score"])
        made = factory.make(task.pop("seed"))
        sizes = made.sizes()
        factory.release(made)
        reply(sizes=sizes)
        _quad_rl.serve_environment(task["name"], factory, sizes=sizes, **task["serve"])
        factory.close()
    except Exception as error:
        if not isinstance(error, EnvironmentFailed):
            traceback.print_exc(file=sys.stderr)
        reply(error=f"{error}")
        sys.stderr.flush()
        os._exit(1)
    # Does not wait for threads of the user or of a simulator.
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
