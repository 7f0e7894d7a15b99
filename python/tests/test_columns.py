"""Columns of LeRobot's robots and of policies: each number goes to the place of its name. No torch is needed."""

from types import SimpleNamespace

import numpy as np
import pytest

from quad_rl._lerobot import act, inputs, places
from quad_rl.readers.lerobot import flat_names


def test_each_number_goes_to_its_column():
    class Episodes:
        def act(self, rows):
            self.rows = rows
            return np.float32([[1, 2], [3, 4]])

    episodes, rows = Episodes(), np.float32([[10, 20, 30], [11, 21, 31]])
    done = act(episodes, rows, places(["c", "a"], ["a", "b", "c"]), places(["left", "right"], ["right", "left"]))
    assert episodes.rows.tolist() == [[30, 10], [31, 11]] and done.tolist() == [[2, 1], [4, 3]]


def test_names_that_several_columns_have_are_told_apart_by_their_order_alone():
    assert places(["g", "g"], ["g", "g"]) == [0, 1]
    assert places(["x"], ["g", "x", "g"]) == [1]
    for wanted, there in (["g", "x"], ["x", "g", "g"]), (["g", "g"], ["g", "x"]):
        with pytest.raises(ValueError, match="several columns g, which cannot be told apart\nhint: "):
            places(wanted, there)
    with pytest.raises(ValueError, match="there is no column y\nhint: there are x"):
        places(["y"], ["x"])


def test_the_names_of_two_arms_keep_their_keys_where_they_repeat():
    assert flat_names({"left": ["j0", "j1"], "right": ["j0", "j1"]}) == ["left.j0", "left.j1", "right.j0", "right.j1"]
    assert flat_names({"left": ["l0"], "right": ["r0"]}) == ["l0", "r0"], "as policies know them"
    assert flat_names({"motors": ["pan", "lift"]}) == flat_names(["pan", "lift"]) == flat_names({"lift": 1, "pan": 0}) == ["pan", "lift"]


def test_features_may_have_two_dots():
    def seen(*names, features=()):
        return inputs(SimpleNamespace(observation_names=list(names), observation_size=len(names)), features)

    names = ["observation.states.ee_state.x", "observation.states.ee_state.y", "observation.states.gripper_state[0]", "observation.state.pan.pos"]
    expected = {"observation.states.ee_state": [0, 1], "observation.states.gripper_state": [2], "observation.state": [3]}
    assert seen(*names) == expected
    names = ["observation.force.left.fx", "observation.images.top.gray[0]", "observation.force.right.fx"]
    features = ["action", "observation.force", "observation.force.left", "observation.force.right", "observation.images.top"]
    assert seen(*names, features=features) == {"observation.force.left": [0], "observation.images.top": [1], "observation.force.right": [2]}
    assert seen("x", "y") == {"observation.state": [0, 1]}
