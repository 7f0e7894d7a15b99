"""The same frames as LeRobot's own class gives, on a folder that it has written; policies that act in LeRobot. It needs torch and
is skipped without it: pip install lerobot==0.4.4 (v3.0), or 0.3.3 with datasets==3.6.0 (v2.1); for policies, lerobot>=0.4.4,
gym-pusht and python/lerobot_policy_quad."""

import inspect
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import train

from quad_rl import Dataset, Policy, export_lerobot

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


def exported(folder, dataset, *more):
    """A policy's folder, and its snapshot."""
    dataset.save(folder / "data.hdf5")
    options = ["--task", "own-data", "--env", "mine", "--steps", "2", "--normalize", "actions,observations", *more]
    snapshot = train(folder / "run", folder / "data.hdf5", *options)
    export_lerobot(snapshot, folder / "policy")
    return folder / "policy", snapshot


def test_a_policy_acts_by_the_names_of_columns(tmp_path):
    quad, torch = pytest.importorskip("lerobot_policy_quad"), pytest.importorskip("torch")
    from lerobot.policies.factory import make_pre_post_processors
    from test_video import RULE, TOP, gray, recorded

    folder, snapshot = exported(tmp_path, Dataset.from_lerobot(recorded(tmp_path / "data"), **RULE, features={TOP: gray}))

    def loaded(state=("roll", "grip", "pan", "lift"), action=("lift", "pan"), encoder="test_video:gray"):
        config = quad.PreTrainedConfig.from_pretrained(folder, cli_overrides=[f"--encoders={json.dumps({TOP: encoder})}"])
        meta = SimpleNamespace(features={"observation.state": {"names": [*state]}, "action": {"names": [*action]}})
        return quad.QuadPolicy.from_pretrained(folder, config=config, dataset_meta=meta)

    policy, rng = loaded(), np.random.default_rng(0)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    state, frames = rng.normal(size=(2, 4)).astype(np.float32), rng.integers(0, 256, (2, 48, 64, 3)).astype(np.uint8)
    batch = {"observation.state": torch.from_numpy(state), TOP: torch.from_numpy(frames).permute(0, 3, 1, 2) / 255}
    torch.manual_seed(0)
    actual = [after(policy.select_action(before(batch))).numpy() for _ in range(2)]
    torch.manual_seed(0)
    seed = int(torch.randint(2**31, ()))
    episodes, rows = Policy.load(snapshot).begin([seed, seed + 1]), np.concatenate([state[:, [2, 3, 0]], gray(frames)], axis=1)
    assert all(np.array_equal(actions, episodes.act(rows)[:, ::-1]) for actions in actual)
    policy.save_pretrained(tmp_path / "again")
    assert (tmp_path / "again/model.safetensors").read_bytes() == snapshot.read_bytes()

    for message, call in {
        "there is no column observation.state.lift\nhint: there are": lambda: loaded(state=["roll", "pan"]),
        "there is no column action.lift": lambda: loaded(action=["pan"]),
        r"sees observation.images.top.gray\[0\], by a function that is not given": lambda: loaded(encoder="test_video:film"),
        "there is no observation.state\nhint: there are": lambda: policy.select_action({TOP: batch[TOP]}),
        "observation.state has 2 numbers, not 4": lambda: policy.select_action({**batch, "observation.state": torch.zeros(2, 2)}),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()


def test_a_chunk_is_new_and_has_the_actions_that_are_executed(tmp_path):
    quad, torch = pytest.importorskip("lerobot_policy_quad"), pytest.importorskip("torch")
    rng, seen, done = np.random.default_rng(0), ["observation.state.a", "observation.state.b"], ["action.x", "action.y"]
    table = {name: rng.uniform(-1, 1, 200) for name in [*seen, *done]} | {"run": np.arange(200) // 50}
    dataset = Dataset.from_frame(table, observations=seen, actions=done, reward="run", episode="run")
    folder, snapshot = exported(tmp_path, dataset, "--agent", "chunk=3", "--agent", "replan=2")
    meta = SimpleNamespace(features={"observation.state": {"names": ["a", "b"]}, "action": {"names": ["y", "x"]}})
    config = quad.PreTrainedConfig.from_pretrained(folder)
    policy = quad.QuadPolicy.from_pretrained(folder, config=config, dataset_meta=meta)
    rows = rng.normal(size=(4, 2)).astype(np.float32)

    def played(seed):
        episodes = Policy.load(snapshot).begin([*range(seed, seed + 4)])
        return np.stack([episodes.act(rows)[:, ::-1] for _ in range(2)], axis=1)

    torch.manual_seed(0)
    one, other = (int(torch.randint(2**31, ())) for _ in range(2))
    torch.manual_seed(0)
    batch = {"observation.state": torch.from_numpy(rows)}
    first, chunk, second = policy.select_action(batch), policy.predict_action_chunk(batch), policy.select_action(batch)
    assert np.array_equal(np.stack([first, second], axis=1), played(one)), "a chunk leaves other episodes as they are"
    assert chunk.shape == (4, 2, 2) and np.array_equal(chunk, played(other))


def test_lerobot_eval_takes_the_path_of_a_policy(tmp_path):
    pytest.importorskip("lerobot_policy_quad"), pytest.importorskip("gym_pusht")
    rng, done = np.random.default_rng(0), ["action[0]", "action[1]"]
    seen = [*(f"observation.environment_state[{i}]" for i in range(16)), "observation.state[0]", "observation.state[1]"]
    table = {name: rng.uniform(0, 512, 200) for name in [*seen, *done]} | {"run": np.arange(200) // 50}
    folder, _ = exported(tmp_path, Dataset.from_frame(table, observations=seen, actions=done, reward="run", episode="run"))
    command = [Path(sys.executable).parent / "lerobot-eval", f"--policy.path={folder}", "--env.type=pusht", "--eval.n_episodes=2",
               "--env.obs_type=environment_state_agent_pos", "--env.episode_length=4", "--eval.batch_size=1", f"--output_dir={tmp_path}"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    assert len(json.loads((tmp_path / "eval_info.json").read_text())["per_task"][0]["metrics"]["sum_rewards"]) == 2
