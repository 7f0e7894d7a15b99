"""A user's environment with flat observations and actions. What it returns is checked here, as `_rows` checks arrays."""

from __future__ import annotations

import inspect
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.random.mtrand import set_bit_generator
from numpy.typing import NDArray

# An action that is clipped by less, relative to its size of at least 1, is rounded.
_ROUNDING = 1e-3
_STEP = "(observation, reward, terminated, truncated, info)"


class EnvironmentFailed(RuntimeError):
    """An error of the user's code, in one line, for the learner."""


class Unusable(EnvironmentFailed):
    """It lacks the form of Gymnasium's environments, so that each step would fail."""


class Stepped(NamedTuple):
    """What follows a step."""

    observation: NDArray[np.float64]
    reward: float
    terminated: bool
    truncated: bool
    intervention: list[float] | None  # The action of a person.
    clipped: list[float] | None  # The action, if the action space has changed it.


def call(function: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    """Calls the user's code. Logs its error in full, and raises it in one line."""
    try:
        return function(*arguments, **keywords)
    except (Exception, SystemExit) as error:
        traceback.print_exc(file=sys.stderr)
        frame = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{os.path.basename(frame.filename)}:{frame.lineno}, in {frame.name}"
        raise EnvironmentFailed(f"{type(error).__name__}: {error} ({place})") from None


def draw_from(generator: np.random.MT19937, seed: int) -> None:
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

    # True in a process that has told of an action space that is narrower than the policy's actions.
    told = False

    def __init__(self, environment: Any, score: str | tuple[float, float]) -> None:
        self.environment = environment
        self.score_rule = score
        self.generator = np.random.MT19937()
        self.info: Mapping[str, Any] = {}
        self.steps = 0
        self.broken = False
        self.unusable: Unusable | None = None
        self.space = getattr(environment, "observation_space", None)
        try:
            parameters = list(inspect.signature(environment.reset).parameters.values())
        except ValueError:  # Of a C extension.
            parameters = []
        self.takes_options = any(parameter.name == "options" or parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
        action_space = getattr(environment, "action_space", None)
        self.action_shape = getattr(action_space, "shape", None)
        is_whole = np.dtype(getattr(action_space, "dtype", None) or float).kind in "biu"
        if action_space is not None and (is_whole or not self.action_shape):
            raise EnvironmentFailed(f"actions must be a box of floats (gymnasium.spaces.Box), as policies give fractions, not {action_space}")
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

    def try_out(self) -> None:
        """Resets it, and steps it by the action 0, or the nearest, where it has an action space. Raises EnvironmentFailed."""
        size, sizes = self.reset(0).size, self.sizes()
        if sizes and size != sizes[0]:
            raise Unusable(f"reset: the observation has {size} numbers, but those of observation_space have {sizes[0]}")
        if self.action_shape is not None:
            action = np.zeros(self.action_shape, np.float32)
            action = action if self.bounds is None else np.clip(action, *self.bounds)
            self.step(np.asarray(action, np.float32).ravel())

    def _row(self, place: str, observation: Any) -> NDArray[np.float64]:
        if self.space is not None and getattr(self.space, "shape", None) is None:
            from gymnasium.spaces import flatten

            for leaf in _leaves(observation):
                _numbers(place, "the observation", leaf)
            observation = flatten(self.space, observation)
        return np.ascontiguousarray(_numbers(place, "the observation", observation), dtype=np.float64).ravel()

    def _run(self, method: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        # The environments of this process share NumPy's global generator.
        set_bit_generator(self.generator)
        self.broken = True
        result = call(method, *arguments, **keywords)
        self.broken = False
        return result

    def _refuse(self, why: str) -> Unusable:
        self.unusable = Unusable(why)
        return self.unusable

    def reset(self, seed: int, online: bool = False) -> NDArray[np.float64]:
        # Many simulators take seeds of 32 bits at most.
        seed %= 2**31
        # Some draw from NumPy's global generator or from the action space, which Gymnasium's reset does not seed.
        draw_from(self.generator, seed)
        for space in _action_spaces(self.environment):
            space.seed(seed)
        options = {"options": {"online": True}} if online and self.takes_options else {}
        answer = self._run(self.environment.reset, seed=seed, **options)
        self.steps = 0
        if not isinstance(answer, (tuple, list)) or len(answer) != 2 or not isinstance(answer[1], (Mapping, type(None))):
            raise self._refuse(f"reset must return (observation, info), as in Gymnasium, not {_short(answer)}")
        return self._row("reset", answer[0])

    def step(self, action: NDArray[np.float32]) -> Stepped:
        given, clipped, size = action, None, action.size
        self.steps += 1
        place = f"step {self.steps}"
        if self.action_shape is not None:
            action = action.reshape(self.action_shape)
        if self.bounds is not None:
            action = np.clip(action, *self.bounds)
            clipped = self._clipped(given, np.asarray(action, np.float32).ravel())
        answer = self._run(self.environment.step, action)
        if not isinstance(answer, (tuple, list)) or len(answer) != 5:
            count = f"{len(answer)} values" if isinstance(answer, (tuple, list)) else _short(answer)
            raise self._refuse(f"step must return {_STEP}, as in Gymnasium, not {count}")
        observation, reward, terminated, truncated, info = answer
        if not isinstance(info, Mapping):
            raise self._refuse(f"{place}: info must be a dictionary, such as {{}}, not {_short(info)}")
        self.info = info
        amount = _numbers(place, "the reward", reward)
        if amount.shape:
            raise self._refuse(f"{place}: the reward must be one number, such as float(reward), not {_short(reward)} of shape {[*amount.shape]}")
        return Stepped(
            self._row(place, observation),
            float(amount),
            _flag(place, "terminated", terminated),
            _flag(place, "truncated", truncated),
            _intervention(place, info.get("intervention"), size),
            clipped,
        )

    @classmethod
    def _clipped(cls, given: NDArray[np.float32], taken: NDArray[np.float32]) -> list[float] | None:
        if np.array_equal(given, taken):
            return None
        off = np.abs(taken - given) / np.maximum(1, np.abs(given))
        if off.max() > _ROUNDING and not cls.told:
            cls.told, i = True, int(off.argmax())
            print(
                f"quad_rl: action_space is narrower than the actions of the data: number {i} of an action is {given[i]:g}, and {taken[i]:g} "
                "is taken (online, that is recorded)",
                file=sys.stderr,
            )
        return [float(number) for number in taken]

    def score(self, episode_return: float) -> float:
        if self.score_rule == "return":
            return float(episode_return)
        if self.score_rule == "success":
            success = self.info.get("success", self.info.get("is_success"))
            if success is None:
                raise EnvironmentFailed('the last info of an episode has neither "success" nor "is_success"')
            return 100.0 * _flag("the last info of an episode", "success", success)
        low, high = map(float, self.score_rule)
        return 100.0 * (episode_return - low) / (high - low)


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:60]}…"


def _leaves(value: Any) -> Iterator[Any]:
    """The arrays of a nested observation."""
    if isinstance(value, (Mapping, tuple)):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _leaves(part)
    elif not isinstance(value, str):
        yield value


def _numbers(place: str, name: str, value: Any) -> NDArray[Any]:
    """As an array of real numbers."""
    if np.ma.is_masked(value):
        raise EnvironmentFailed(f"{place}: {name} has masked numbers, which were not measured; fill them, as by numpy.ma's filled(0)")
    try:
        array = np.asarray(value)
    except Exception as error:  # Of lists of several lengths, or a tensor's own.
        raise EnvironmentFailed(f"{place}: {name} is {_short(value)}, which is no array: {error}") from None
    if array.dtype.kind not in "biuf":
        raise EnvironmentFailed(f"{place}: {name} must consist of real numbers, not {_short(value)} (NumPy's {array.dtype})")
    return array


def _flag(place: str, name: str, value: Any) -> bool:
    if np.ma.is_masked(value) or np.shape(value) or value not in (0, 1):
        raise EnvironmentFailed(f"{place}: {name} is {_short(value)}, neither true nor false")
    return bool(value)


def _intervention(place: str, taken: Any, size: int) -> list[float] | None:
    """The action that a person took."""
    if taken is None:
        return None
    name = 'info["intervention"]'
    array = _numbers(place, name, taken)
    with np.errstate(over="ignore"):
        action = array.astype(np.float32).ravel()
    if array.dtype.kind == "b" or action.size != size or not np.isfinite(action).all():
        what = f"{size} finite numbers, the action that was taken, or absent"
        raise EnvironmentFailed(f"{place}: {name} must be {what}, not {_short(taken)}")
    return action.tolist()
