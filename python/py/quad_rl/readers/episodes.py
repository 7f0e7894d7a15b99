"""From a source's episodes to transitions: observed columns, rewards, and ends of the task."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Union

import numpy as np
from numpy.typing import NDArray

from quad_rl._rows import Source, episode_rows, joined, plain

# A word or the name of a column, or a function of an episode, which is a dictionary of its columns, T rows each, and `episode`,
# its number or name.
Rule = Union[str, Callable[[Mapping[str, Any]], Any], None]
# Also the successful episodes' numbers or names, or a flag for each episode.
Success = Union[Rule, Sequence[Any]]
_HOW = 'success= a column, "all", a list of episodes, or a function of the episode'
_MANY = 0.1  # Smallest share of rows after a success to warn of; in a few the robot comes to rest.
FEWEST = 20  # Steps by which a clock is known.
_EVEN = 0.9  # Smallest share of them near the median.
_OF_SUCCESS = {"success-at-end": (0.0, 1.0), "step-cost": (-1.0, 0.0)}


class Episode(NamedTuple):
    """T steps."""

    name: Any  # Its number or name in the source.
    columns: dict[str, NDArray[Any]]  # A row each step.
    last: dict[str, NDArray[Any]]  # A row each: what was observed after the last step. Empty if that is not stored.

    @property
    def steps(self) -> int:
        return max(map(len, self.columns.values()), default=0)


class Log(NamedTuple):
    """The contents of a source."""

    episodes: list[Episode]
    notes: list[str]
    there: Sequence[str] = ()  # All columns, also those that were not read.
    names: Mapping[str, Sequence[str]] = {}  # Of the numbers in a column, if it has any.
    reward: str = ""  # The column with rewards, if there is one; `success` and `done`, which is set at any end, likewise.
    success: str = ""
    done: str = ""
    terminated: str = ""  # The column that is set where the task itself was over.
    end: str = "terminate"  # The reader's name of `terminate`.
    continuous: bool = False  # Whole numbers are actions, too.


def rule_columns(*rules: Any) -> set[str] | None:
    """The columns that these rules name, words among them; None, all of them, where a function may look at any."""
    rules = tuple([rule] if isinstance(rule, str) or callable(rule) else rule for rule in rules if rule is not None)
    flat = [name for rule in rules for name in rule]
    return None if any(map(callable, flat)) else {name for name in flat if isinstance(name, str)}


def width(array: NDArray[Any]) -> int:
    """Numbers in a row."""
    return int(np.prod(array.shape[1:]))


def is_number(value: Any) -> bool:
    """True if `float` takes it."""
    try:
        float(value)
        return True
    except (TypeError, ValueError):
        return False


def dataset(
    log: Log, observations: Sequence[str], actions: Sequence[str], reward: Rule, success: Success, terminate: Rule
) -> Source:
    """The transitions of a source. Raises ValueError, with a hint, for what it does not have and nothing else says."""
    episodes, notes = [episode for episode in log.episodes if episode.steps], log.notes
    count, stepless = len(episodes), len(log.episodes) - len(episodes)
    log = log._replace(episodes=episodes)
    if stepless:
        notes.append(f"{stepless} of {count + stepless} episodes dropped: without a step")
    if not episodes:
        raise ValueError("\n".join(["there is no episode", *notes]))
    if any(isinstance(columns, str) or not columns for columns in (observations, actions)):
        raise ValueError("observations and actions are lists of columns, of one at least")
    for name in [*observations, *actions]:
        _check(log, name)
    won = _successes(log, success)
    reward, terminate = _reward(log, reward, won), _terminate(log, terminate, won)
    parts, lost, open_ended = [], 0, 0
    for episode, has_won in zip(episodes, won or [False] * count):
        steps = len(episode.columns[actions[0]])
        ends = _flags(terminate, episode, has_won, steps)
        rewards = _rewards(reward, episode, has_won, steps)
        seen = [_beside(part, observations) for part in (episode.columns, episode.last) if part]
        open_ended += not episode.last and not ends[-1]
        lost += has_won and not episode.last and not ends[-1] and reward in _OF_SUCCESS
        done = _beside(episode.columns, actions)
        rows = {"observations": np.concatenate(seen), "actions": done.astype(float) if log.continuous else done, "rewards": rewards}
        parts.append(episode_rows(f"episode {episode.name}: ", {**rows, "terminated": ends, "truncated": False}))
    if lost:
        pays = f"reward={reward!r} pays at the last step, which is dropped unless an episode terminates: {lost} of {count}"
        raise ValueError(f'{pays}\nhint: {log.end}="success", or rewards of your own')
    if open_ended:
        notes.append(f"{open_ended} of {count} episodes: the last step is dropped, as what followed it is not stored and "
                     "nothing terminates there")
    empty = sum(not len(part.rewards) for part in parts)
    if empty:
        notes.append(f"{empty} of {count} episodes dropped: of a single step, without what followed it")
    names = [[name for column in columns for name in _names(log, column)] for columns in (observations, actions)]
    for several in [name for array in names for name in array if array.count(name) > 1][:1]:
        hint = "hint: each number needs its own, by which policies and robots find it; rename it in the source (LeRobot: meta/info.json)"
        raise ValueError(f"several numbers of an observation or an action are called {several!r}\n{hint}")
    transitions = joined(parts)
    return Source(transitions, (names[0], names[1]), notes + _clocks(log, observations))


def _check(log: Log, name: str) -> None:
    lacking = [episode for episode in log.episodes if name not in episode.columns]
    if lacking:
        some = len(lacking) < len(log.episodes)
        there = lacking[0].columns if some else log.there or lacking[0].columns
        where = f" in episode {lacking[0].name} ({len(lacking)} such episodes)" if some else ""
        raise ValueError(f"there is no column {name!r}{where}\nhint: there are {', '.join(map(repr, there))}")
    if log.episodes[0].columns[name].dtype.kind not in "fiub":
        values = [(episode.name, row, value) for episode in log.episodes
                  for row, numbers in enumerate(episode.columns[name]) for value in np.ravel(numbers)]
        number, row, value = next((place for place in values if not is_number(place[2])), values[0])
        hint = "hint: numbers are written like 0.5; leave out rows without one, or fill them"
        raise ValueError(f"column {name!r}, row {row} of episode {number} holds {str(value)!r} in place of a number\n{hint}")


def _names(log: Log, column: str) -> list[str]:
    array, given = log.episodes[0].columns[column], log.names.get(column, ())
    if len(given) == width(array):
        return [f"{column}.{name}" for name in given]
    return [column] if array.ndim == 1 else [f"{column}[{i}]" for i in range(width(array))]


def _beside(columns: Mapping[str, NDArray[Any]], names: Sequence[str]) -> NDArray[Any]:
    return np.concatenate([columns[name].reshape(len(columns[name]), -1) for name in names], axis=1)


def _clocks(log: Log, observations: Sequence[str]) -> list[str]:
    """Warns of observations that grow evenly, as times and row numbers do."""
    clocks = []
    for column in observations:
        steps = np.concatenate([np.diff(_beside(episode.columns, [column]).astype(float), axis=0) for episode in log.episodes])
        if len(steps) >= FEWEST:
            usual = np.median(steps, axis=0)
            even = np.mean(abs(steps - usual) <= usual / 4, axis=0)
            clocks += [name for name, by, share in zip(_names(log, column), usual, even) if by > 0 and share > _EVEN]
    return [f"{', '.join(clocks)}: grows by about the same in each step, as a clock does; leave it out of the observations, unless "
            "what to do depends on the time"] if clocks else []


def _call(rule: Callable[[Mapping[str, Any]], Any], episode: Episode) -> Any:
    return rule({"episode": episode.name, **episode.columns})


def _successes(log: Log, rule: Success) -> list[bool] | None:
    names = [episode.name for episode in log.episodes]
    rule = log.success or None if rule is None else rule
    if rule is None:
        return None
    by_text = {_text(name): name for name in names}
    if isinstance(rule, str) and rule in by_text and rule not in log.episodes[0].columns:
        rule = [rule]
    if callable(rule):
        return [bool(_call(rule, episode)) for episode in log.episodes]
    if isinstance(rule, str):
        if rule == "all":
            return [True] * len(log.episodes)
        _check(log, rule)
        flags = [episode.columns[rule].reshape(-1) > 0 for episode in log.episodes]
        _suspect_going_on(log, rule, flags)
        return [bool(flag.any()) for flag in flags]
    listed = list(rule)
    if listed and all(isinstance(flag, (bool, np.bool_)) for flag in listed):
        if len(listed) != len(names):
            raise ValueError(f"success has {len(listed)} flags, but there are {len(names)} episodes\nhint: list their numbers")
        return [bool(flag) for flag in listed]
    chosen = {by_text.get(name, name) if isinstance(name, str) else name for name in listed}
    if len({*names}) < len(names):
        raise ValueError('success lists names, of which some are those of several episodes\nhint: success= a column, or "all"')
    strangers = chosen - {*names}
    if strangers:
        raise ValueError(f"success names episodes that are not there: {[*strangers][:5]} ({len(strangers)} such)")
    return [name in chosen for name in names]


def _text(name: Any) -> str:
    return str(int(name)) if isinstance(name, float) and name.is_integer() else str(name)


def _suspect_going_on(log: Log, rule: str, flags: list[NDArray[np.bool_]]) -> None:
    """Warns of many rows after their episode's success. A flag in all rows is the episode's."""
    later = sum(len(flag) - 1 - int(np.argmax(flag)) for flag in flags if flag.any() and not flag.all())
    rows = sum(map(len, flags))
    if later > _MANY * rows:
        log.notes.append(f"{later} of {rows} rows ({later / rows:.0%}) come after their episode's first {rule}, as if the task went on: "
                         "leave them out of the source if it was over there")


def _reward(log: Log, rule: Rule, won: list[bool] | None) -> Rule:
    rule = rule or log.reward
    ways = '"success-at-end" (1 there), "step-cost" (-1 a step, 0 there), "none" (to clone), a column, or a function of the episode'
    if not rule:
        raise ValueError(f"no rewards were recorded, and nothing says what is rewarded\nhint: reward={ways}; {_HOW}")
    if rule in _OF_SUCCESS:
        if won is None:
            raise ValueError(f"reward={rule!r} needs to know which episodes are successes\nhint: {_HOW}")
        log.notes.append(f"{sum(won)} of {len(won)} episodes are successes")
    elif isinstance(rule, str) and rule != "none":
        _check(log, rule)
    return rule


def _terminate(log: Log, rule: Rule, won: list[bool] | None) -> Rule:
    if rule is None and log.terminated:
        over = sum(bool(np.any(episode.columns[log.terminated] > 0)) for episode in log.episodes)
        log.notes.append(f"{over} of {len(log.episodes)} episodes terminate, as {log.terminated} says; the others are cut off")
        return log.terminated
    done = [bool(log.done and np.any(episode.columns[log.done] > 0)) for episode in log.episodes]
    unsure = sum(ends and not success for ends, success in zip(done, won or [False] * len(done)))
    at = f"{unsure} of {len(done)} episodes have {log.done} without a success, as at a time limit"
    ways = f'{log.end}="success" (with success=…), "never", "{log.done or "a column"}", or a function of the episode'
    if rule is None and won is None and unsure:
        raise ValueError(f"{at}: nothing says whether the task was over there\nhint: {ways}")
    if rule is None and won is None:
        log.notes.append(f"no episode terminates, as nothing says where the task was over ({ways})")
        return "never"
    rule = rule or "success"
    if rule == "success" and won is None:
        raise ValueError(f'{log.end}="success" needs {_HOW}')
    if isinstance(rule, str) and rule not in ("success", "never"):
        _check(log, rule)
    if won is not None and unsure and rule in ("success", log.done):
        log.notes.append(f"{at}: they count as {'terminated' if rule == log.done else 'cut off'}")
    return rule


def _flags(rule: Rule, episode: Episode, has_won: bool, steps: int) -> NDArray[Any]:
    """True where the task was over after a step."""
    if callable(rule) or rule not in ("success", "never"):
        given = plain("", "", _call(rule, episode)) if callable(rule) else episode.columns[str(rule)]
        if given.ndim:
            return given.reshape(-1)
        has_won = bool(given)
    ends = np.zeros(steps, bool)
    ends[-1] = has_won and rule != "never"
    return ends


def _rewards(rule: Rule, episode: Episode, has_won: bool, steps: int) -> Any:
    if callable(rule):
        return _call(rule, episode)
    if rule == "none":
        return np.zeros(steps)
    if rule not in _OF_SUCCESS:
        return episode.columns[str(rule)]
    step, end = _OF_SUCCESS[str(rule)]
    rewards = np.full(steps, step)
    rewards[-1] = end if has_won else step
    return rewards
