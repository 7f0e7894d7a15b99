"""The ROS 2 node of examples/, with a fake of rclpy, which pip cannot install, and chunks that are computed ahead."""

import re
import runpy
import sys
from pathlib import Path
from threading import Semaphore
from types import ModuleType, SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from conftest import train

from quad_rl import Dataset, Policy

EXAMPLES = Path(__file__).parents[2] / "examples"
JOINTS = ["shoulder", "elbow"]
SEEN = [f"{part}.{joint}" for part in ("position", "velocity") for joint in JOINTS]


@pytest.fixture(scope="module")
def snapshot(tmp_path_factory):
    """A policy for a robot with two joints, in another order than the controller's."""
    folder, rng = tmp_path_factory.mktemp("robot"), np.random.default_rng(0)
    numbers = {name: rng.normal(size=400) for name in SEEN}
    done = {f"torque.{joint}": rng.uniform(-9, 9, 400) for joint in ("elbow", "shoulder")}
    frame = pd.DataFrame({**numbers, **done, "gain": rng.normal(size=400), "run": np.arange(400) // 50})
    Dataset.from_frame(frame, observations=SEEN, actions=[*done], reward="gain", episode="run", terminal="never").save(folder / "log.hdf5")
    return train(folder / "run", folder / "log.hdf5", "--task", "own-data", "--env", "mine", "--steps", "2", "--normalize", "actions")


class Node:
    """rclpy's Node: records published and logged messages."""

    def __init__(self, name):
        self.published, self.errors = [], []

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.published.append(message.data))

    def create_subscription(self, kind, topic, callback, depth):
        self.receive = callback

    def get_logger(self):
        return SimpleNamespace(error=self.errors.append)


def message(names, position, velocity):
    return SimpleNamespace(name=names, position=position, velocity=velocity, effort=[])


def test_the_node_maps_joints_by_name(snapshot, tmp_path, monkeypatch):
    spun, modules = [], {name: ModuleType(name) for name in ("rclpy", "rclpy.node", "sensor_msgs", "sensor_msgs.msg", "std_msgs", "std_msgs.msg")}
    modules["rclpy"].init, modules["rclpy"].spin, modules["rclpy.node"].Node = lambda: None, spun.append, Node
    modules["sensor_msgs.msg"].JointState, modules["std_msgs.msg"].Float64MultiArray = object, SimpleNamespace
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.chdir(tmp_path)
    Path("policy.safetensors").write_bytes(snapshot.read_bytes())
    runpy.run_path(str(EXAMPLES / "ros2.py"))
    node, episodes = spun[0], Policy.load(snapshot).begin([0])
    node.receive(message(["shoulder", "elbow"], [0.1, 0.2], [0.3, 0.4]))
    node.receive(message(["gripper", "elbow", "shoulder"], [9.0, 0.2, 0.1], [np.nan, 0.4, 0.3]))
    state = np.array([[0.1, 0.2, 0.3, 0.4]], np.float32)
    for command in node.published:
        np.testing.assert_allclose(command, episodes.act(state)[0][::-1], rtol=1e-6)  # The controller's order.
    assert len(node.published) == 2 and not node.errors
    node.receive(message(["shoulder", "elbow"], [0.1, float("nan")], [0.3, 0.4]))
    node.receive(message(["shoulder", "elbow"], [0.1, 0.2], []))
    node.receive(message(["shoulder", "wrist"], [0.1, 0.2], [0.3, 0.4]))
    assert len(node.published) == 2, "no command without a whole state"
    assert [re.search("position.elbow|velocity.shoulder", error).group() for error in node.errors] == ["position.elbow", "velocity.shoulder", "position.elbow"]
    assert "NaN" in node.errors[0] and "lacks" in node.errors[1]


CHUNKS = runpy.run_path(str(EXAMPLES / "chunks.py"))


class Slow:
    """A policy whose chunks, ten times what it sees and three more, take until they are released."""

    def __init__(self):
        self.about, self.left, self.released = {"chunk": {"history": 1, "length": 6, "replan": 4}}, [], Semaphore(0)

    def begin(self, seed):
        return self

    def act(self, seen):
        if not self.left:
            assert self.released.acquire(timeout=60)
            if seen is None:
                raise ValueError("nothing seen")
            self.left = [10 * seen + i for i in range(4)]
        return self.left.pop(0)


def test_a_late_chunk_loses_the_actions_whose_time_has_passed():
    policy = Slow()
    ahead = CHUNKS["Ahead"](policy)

    def computed():
        policy.released.release()
        ahead.coming.result(60)

    with pytest.raises(ValueError, match="late"):
        ahead.act(None)
    with pytest.raises(ValueError, match="nothing seen"):
        computed()
    for error in ("nothing seen", "late"):
        with pytest.raises(ValueError, match=error):
            ahead.act(0)
    computed()
    assert [ahead.act(seen) for seen in (1, 2, 3, 4)] == [0, 1, 2, 3], "nothing was executed before"
    with pytest.raises(ValueError, match="late"):
        ahead.act(5)
    computed()  # Of what was seen two actions ago.
    assert (ahead.act(6), ahead.dropped) == (32, 2)
    assert ahead.act(7) == 33
    computed()
    assert [ahead.act(seen) for seen in (8, 9)] == [71, 72]
    computed()
    assert ahead.act(10) == 91, "a chunk that is there takes the place of the last one"


def test_chunks_are_executed_at_30_hertz(snapshot, tmp_path):
    given = ["--task", "own-data", "--env", "mine", "--steps", "2", "--normalize", "actions", "--algorithm", "qc"]
    policy = Policy.load(train(tmp_path / "run", snapshot.parents[2] / "log.hdf5", *given))
    ahead = CHUNKS["Ahead"](policy)
    took, missed = CHUNKS["loop"](ahead.act, policy.observation_size, steps=60)
    assert len(took) == 60 and missed < 30, missed
    seen = dict.fromkeys(SEEN, 0.5)
    np.testing.assert_array_equal(CHUNKS["Ahead"](policy).chunk(0, [seen])[0], policy.begin(0).act(seen))
