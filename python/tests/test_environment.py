"""What environments return is checked where it comes in, by name and step."""

import numpy as np
import pytest

from quad_rl import _worker
from test_evaluate import OBSERVATION, Walk

ACTION = 3


@pytest.mark.parametrize("success", [float("nan"), 0.5, {"task": False}])
def test_refuses_a_success_that_is_not_boolean(success):
    made = _worker.WrappedEnvironment(Walk(), "success")
    made.info = {"success": np.True_}
    assert made.score(0.0) == 100.0
    made.info = {"is_success": success}
    with pytest.raises(_worker.EnvironmentFailed, match="neither true nor false"):
        made.score(0.0)


def test_references_score_0_and_100():
    made = _worker.WrappedEnvironment(Walk(), (-20.0, 30.0))
    assert [made.score(total) for total in (-20.0, 5.0, 30.0)] == [0.0, 50.0, 100.0]


def test_an_intervention_replaces_the_action():
    class Held(Walk):
        def step(self, action):
            *stepped, info = super().step(action)
            return *stepped, {**info, "intervention": held}

    made = _worker.WrappedEnvironment(Held(), "return")
    made.reset(1)
    for held, expected in (None, None), (np.array([[0.5], [1.0], [0.25]]), [0.5, 1.0, 0.25]), ([1, 0, -1], [1.0, 0.0, -1.0]):
        assert made.step(np.zeros(ACTION, np.float32)).intervention == expected
    for held in [0.5], [np.nan, 0, 0], [True] * 3, [1e300, 0, 0]:
        with pytest.raises(_worker.EnvironmentFailed, match='"intervention". must be 3 finite numbers'):
            made.step(np.zeros(ACTION, np.float32))
    with pytest.raises(_worker.EnvironmentFailed, match='must be 1 finite numbers, .*, or absent, not False'):
        held = False  # As a flag, with an action of one number.
        made.step(np.zeros(1, np.float32))


class Space:
    """A box of Gymnasium's."""

    def __init__(self, shape, low=None, high=None, dtype=np.float32):
        self.shape, self.low, self.high, self.dtype = shape, low, high, np.dtype(dtype)


def answering(**changed):
    """An environment whose step returns a part as it is given, and how it is used."""
    usual = {"observation": np.zeros(OBSERVATION), "reward": 1.0, "terminated": False, "truncated": False, "info": {}}

    class Answers:
        def reset(self, seed=None):
            return usual["observation"], {}

        def step(self, action):
            self.action = action
            return tuple((usual | changed).values())

    made = _worker.WrappedEnvironment(Answers(), "return")
    made.reset(0)
    return made


@pytest.mark.parametrize("part, value, message", [
    ("observation", np.ma.masked_array(np.ones(OBSERVATION), np.arange(OBSERVATION) == 3), "the observation has masked numbers"),
    ("observation", np.ones(OBSERVATION, complex), "the observation must consist of real numbers.*complex128"),
    ("observation", [None] * OBSERVATION, "the observation must consist of real numbers.*object"),
    ("observation", [[1.0, 2.0], [3.0]], "the observation is .*, which is no array"),
    ("reward", np.array([1.0]), r"the reward must be one number, such as float.reward., not array..1... of shape .1."),
    ("reward", "1.0", "the reward must consist of real numbers"),
    ("reward", None, "the reward must consist of real numbers, not None"),
    ("reward", 1 + 2j, "the reward must consist of real numbers"),
    ("reward", np.ma.masked, "the reward has masked numbers"),
    ("terminated", float("nan"), "terminated is nan, neither true nor false"),
    ("terminated", "False", "terminated is 'False', neither true nor false"),
    ("terminated", None, "terminated is None, neither true nor false"),
    ("truncated", 0.5, "truncated is 0.5, neither true nor false"),
    ("truncated", np.array([True]), r"truncated is array..\s*True.., neither true nor false"),
    ("info", None, "info must be a dictionary, such as {}, not None"),
])
def test_what_a_step_returns_is_checked_by_name_and_step(part, value, message):
    made = answering()
    made.step(np.zeros(ACTION, np.float32))
    made.environment.step = answering(**{part: value}).environment.step
    with pytest.raises(_worker.EnvironmentFailed, match=f"^step 2: {message}"):
        made.step(np.zeros(ACTION, np.float32))


def test_numbers_and_flags_of_any_library_are_taken():
    taken = answering(reward=np.float32(0.5), terminated=np.True_, truncated=np.array(0), observation=[1] * OBSERVATION)
    stepped = taken.step(np.zeros(ACTION, np.float32))
    assert stepped[1:] == (0.5, True, False, None, None) and stepped.observation.tolist() == [1.0] * OBSERVATION
    assert np.isnan(answering(reward=np.nan).step(np.zeros(ACTION, np.float32)).reward), "an evaluator cuts an online episode there"


def test_the_action_taken_is_the_clipped_one_and_a_narrow_space_is_told_once(capfd, monkeypatch):
    monkeypatch.setattr(_worker.WrappedEnvironment, "told", False)
    made = answering()
    made.action_shape, made.bounds = (ACTION,), (np.float64([-0.3] * 3), np.float64([0.3] * 3))
    inside = np.float32([0.3, -0.3, 0.1])
    assert made.step(inside).clipped is None and np.array_equal(made.environment.action.astype(np.float32), inside)
    assert made.step(np.float32([0.3001, 0, 0])).clipped is not None and not capfd.readouterr().err, "rounding is not told"
    for _ in range(2):
        beyond = made.step(np.float32([0.1, -0.5, 0.9]))
        assert beyond.clipped == np.float32([0.1, -0.3, 0.3]).tolist() == np.float32(made.environment.action).tolist()
    told = capfd.readouterr().err
    assert told.count("action_space is narrower") == 1 and "number 2 of an action is 0.9, and 0.3 is taken" in told
    made.bounds = np.float32([-2, 0, -0.5]), np.float32([2, 1, 0.5])
    assert made.step(np.float32([5, -5, 5])).clipped == [2.0, 0.0, 0.5] == made.environment.action.tolist(), "in its own units"


def test_an_environment_of_another_form_is_told_before_the_first_job():
    class Old(Walk):
        observation_space, action_space = Space((OBSERVATION,)), Space((ACTION,), np.float32([0.1] * 3), np.float32([1.0] * 3))

        def step(self, action):
            self.action = action
            return super().step(action)[:4]

    class Bare(Walk):
        def reset(self, seed=None):
            return super().reset(seed)[0][:2]

    class Small(Old):
        observation_space = Space((OBSERVATION + 1,))

    class Fails(Old):
        def step(self, action):
            raise ValueError("the cable is loose")

    made = _worker.WrappedEnvironment(Old(), "return")
    with pytest.raises(_worker.EnvironmentFailed, match=r"^step must return .observation, reward, .* not 4 values"):
        made.try_out()
    assert np.array_equal(made.environment.action, np.float32([0.1] * 3)), "the action of the space that is nearest to 0"
    for kind, message in (Bare, r"^reset must return .observation, info."), (Small, "has 11 numbers, .* have 12"), (Fails, "the cable is loose"):
        with pytest.raises(_worker.EnvironmentFailed, match=message):
            _worker.WrappedEnvironment(kind(), "return").try_out()
    _worker.WrappedEnvironment(Walk(), "return").try_out()
    for dtype in np.int64, np.int8:
        Old.action_space = Space((ACTION,), dtype=dtype)
        with pytest.raises(_worker.EnvironmentFailed, match="actions must be a box of floats .*, as policies give fractions"):
            _worker.WrappedEnvironment(Old(), "return")


def test_reset_says_which_episodes_are_online():
    class Told(Walk):
        def reset(self, seed=None, options=None):
            self.options = options
            return super().reset(seed)

    made = _worker.WrappedEnvironment(Told(), "return")
    for online, options in (True, {"online": True}), (False, None):
        made.reset(1, online)
        assert made.environment.options == options
    _worker.WrappedEnvironment(Walk(), "return").reset(1, True)
