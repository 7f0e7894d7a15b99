"""The same frames as LeRobot's own class gives, on a folder that it has written. It needs torch and is skipped without it:
pip install lerobot==0.4.4 (v3.0), or 0.3.3 with datasets==3.6.0 (v2.1)."""

import inspect

import numpy as np
import pytest

from quad_rl import Dataset

FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (3,), "names": ["a", "b", "c"]},
    "observation.grid": {"dtype": "float32", "shape": (2, 2), "names": None},
    "observation.image": {"dtype": "image", "shape": (16, 16, 3), "names": ["height", "width", "channels"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["x", "y"]},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


def test_its_own_class_sees_the_same_frames(tmp_path):
    theirs = pytest.importorskip("lerobot.datasets.lerobot_dataset").LeRobotDataset
    rng, root = np.random.default_rng(0), tmp_path / "data"
    written = theirs.create("me/test", fps=10, features=FEATURES, root=root, use_videos=False)
    for episode in range(6):
        for step in range(5 + episode):
            last = step == 4 + episode
            frame = {name: rng.normal(size=feature["shape"]).astype(np.float32) for name, feature in FEATURES.items()}
            frame["observation.image"] = rng.integers(0, 255, (16, 16, 3)).astype(np.uint8)
            frame |= {"next.success": np.array([last and episode % 3 == 0]), "next.done": np.array([last])}
            task = {"task": "pick it up"}
            written.add_frame(frame, **task) if "task" in inspect.signature(theirs.add_frame).parameters else written.add_frame(frame | task)
        written.save_episode()
    getattr(written, "finalize", lambda: None)()
    read = theirs("me/test", root=root)
    columns = {name: np.array([np.asarray(read[i][name]).reshape(-1) for i in range(len(read))]) for name in
               ["observation.state", "observation.grid", "action", "next.reward", "next.success", "episode_index"]}
    success, number = columns["next.success"][:, 0], columns["episode_index"][:, 0]
    kept = success | np.append(number[1:] == number[:-1], False)
    seen = np.concatenate([columns["observation.grid"], columns["observation.state"]], axis=1)
    rows = Dataset.from_lerobot(root, observations=["observation.grid", "observation.state"])._rows
    assert np.array_equal(rows.observations, seen[kept]) and np.array_equal(rows.actions, columns["action"][kept])
    assert np.array_equal(rows.rewards, columns["next.reward"][kept, 0]) and np.array_equal(rows.terminals, success[kept])
    assert np.array_equal(rows.next_observations[~rows.terminals], np.roll(seen, -1, 0)[kept][~rows.terminals]) and len(rows.rewards) == 41
