"""LeRobot's folders: what becomes of their frames, and what has to be said of them. The expected numbers are taken from what
was written, by hand."""

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot_folder import episodes, write

from quad_rl import Dataset

STATE = {"observations": ["observation.state"]}


def rows(dataset):
    return [np.array(array) for array in dataset._rows]


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(rows(a), rows(b)))


def expected(given, ends):
    """Transitions of episodes whose last step is kept where `ends` has them, with what followed as itself."""
    o, a, after, terminals = [], [], [], []
    for i, one in enumerate(given):
        state, kept = np.asarray(one["observation.state"], np.float32), len(one["action"]) - (i not in ends)
        o.append(state[:kept])
        a.append(np.asarray(one["action"], np.float32)[:kept])
        after.append(np.concatenate([state[1:], state[-1:]])[:kept])
        terminals.append(np.arange(kept) == (kept - 1 if i in ends else kept))
    return [np.concatenate(x) for x in (o, a, after, terminals)]


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_teleoperation_gets_the_rewards_that_are_asked_for(tmp_path, version):
    given = episodes()
    folder = write(tmp_path / "data", given, version)
    dataset = Dataset.from_lerobot(folder, **STATE, reward="step-cost", success=[0, 3])
    actual = rows(dataset)
    for array, by_hand in zip((actual[0], actual[1], actual[3], actual[4]), expected(given, {0, 3})):
        assert np.array_equal(array, by_hand)
    ends = np.flatnonzero(actual[4])
    assert len(ends) == 2 and (actual[2][ends] == 0).all() and np.delete(actual[2], ends).tolist() == [-1] * (len(actual[2]) - 2)
    assert np.flatnonzero(actual[5]).tolist() == [4 + 5 - 0, 4 + 5 + 6, 4 + 5 + 6 + 8 + 8 - 0, 4 + 5 + 6 + 8 + 8 + 9]
    assert dataset.observation_names == [f"observation.state.{name}" for name in ("pan", "lift", "roll")]
    assert dataset.action_names == ["action.pan", "action.lift"]
    told = "\n".join(dataset.notes)
    assert "1 streams of images (observation.images.top)" in told and "2 of 6 episodes are successes" in told
    assert "4 of 6 episodes: the last step is dropped" in told and told in str(dataset).replace("  - ", "")

    paid = Dataset.from_lerobot(folder, **STATE, reward="success-at-end", success=np.arange(6) % 3 == 0)
    assert rows(paid)[2][ends].tolist() == [1, 1] and rows(paid)[2].sum() == 2
    assert same(paid, Dataset.from_lerobot(folder, **STATE, reward="success-at-end", success="is_success"))
    by_function = Dataset.from_lerobot(folder, **STATE, success=lambda e: e["episode"] in (0, 3),
                                       reward=lambda e: np.where(e["frame_index"] + 1 == len(e["action"]), e["episode"] in (0, 3), 0))
    assert same(paid, by_function)


def test_files_chunks_row_groups_and_versions_do_not_matter(tmp_path):
    given, read = episodes(7, simulated=True), []
    for i, how in enumerate([{}, {"per_file": 1, "row_group": 2}, {"per_file": 7}, {"shuffle": np.random.default_rng(0)},
                             {"version": "v2.1"}, {"version": "v2.1", "shuffle": np.random.default_rng(1), "row_group": 1}]):
        read.append(Dataset.from_lerobot(write(tmp_path / str(i), given, **how), **STATE))
    assert all(same(read[0], other) for other in read[1:])
    actual = rows(read[0])
    for array, by_hand in zip((actual[0], actual[1], actual[3], actual[4]), expected(given, {0, 2, 4, 6})):
        assert np.array_equal(array, by_hand)
    assert "3 of 7 episodes have next.done without a success, as at a time limit: they count as cut off" in read[0].notes


def test_what_ends_an_episode_is_asked_for(tmp_path):
    given = episodes(simulated=True)
    for one in given:
        del one["next.success"]
    folder = write(tmp_path / "data", given)
    with pytest.raises(ValueError, match="6 of 6 episodes have next.done without a success, as at a time limit: nothing says"):
        Dataset.from_lerobot(folder, **STATE)
    assert rows(Dataset.from_lerobot(folder, **STATE, terminate="next.done"))[4].sum() == 6
    assert rows(Dataset.from_lerobot(folder, **STATE, terminate="never"))[4].sum() == 0
    with pytest.raises(ValueError, match="pays at the last step.*: 6 of 6\nhint: terminate="):
        Dataset.from_lerobot(folder, **STATE, reward="success-at-end", success="all", terminate="never")


def test_a_copied_last_frame_is_the_last_observation(tmp_path):
    given = episodes(simulated=True)
    plain = Dataset.from_lerobot(write(tmp_path / "plain", given), **STATE)
    for one in given:
        for name in ("action", "next.reward", "next.success", "next.done"):
            one[name] = np.concatenate([one[name], one[name][-1:]])
        one["observation.state"] = np.concatenate([one["observation.state"], np.full((1, 3), 7.0)])
    copied = Dataset.from_lerobot(write(tmp_path / "copied", given), **STATE)
    assert len(copied) == len(plain) + 3 == sum(5 + i for i in range(6))
    ends = np.flatnonzero(rows(copied)[4] | rows(copied)[5])
    assert len(ends) == 6 and (rows(copied)[3][ends] == 7).all()
    assert "6 of 6 episodes go on after next.done: the next frame is read as their last observation, 0 frames" in copied.notes[1]

    for one in given:
        one["next.reward"] = np.zeros(len(one["action"]))
        one["next.reward"][-3] = 1.0
    shifted = Dataset.from_lerobot(write(tmp_path / "shifted", given), **STATE)
    assert "next.reward is largest a step before next.success in 3 of 3 successes" in "\n".join(shifted.notes)


def test_several_tasks_are_told_apart(tmp_path):
    given = episodes()
    given[4]["task"] = given[5]["task"] = "place"
    folder = write(tmp_path / "data", given)
    with pytest.raises(ValueError, match=r"several tasks: 'pick' \(4 episodes\), 'place' \(2 episodes\)\nhint: task="):
        Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all")
    place = Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all", task="place")
    assert len(place) == 9 + 10 and "4 of 6 episodes dropped: of another task than 'place'" in place.notes
    assert len(Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all", task="all")) == sum(range(5, 11))
    with pytest.raises(ValueError, match="no episode is of task 'push' alone: 'pick'"):
        Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all", task="push")


def test_the_task_of_each_frame_counts(tmp_path):
    given = episodes()
    for one in given[4:]:
        one["task"] = ["pick"] * (len(one["action"]) - 2) + ["place"] * 2
    folder, rule = write(tmp_path / "data", given), {**STATE, "reward": "step-cost", "success": "all"}
    told = r"'pick' \(4 episodes\), 'pick' and 'place' \(2 episodes, each of several\)\nhint: task="
    for asked in ({}, {"task": "place"}):
        with pytest.raises(ValueError, match=told):
            Dataset.from_lerobot(folder, **rule, **asked)
    pick = Dataset.from_lerobot(folder, **rule, task="pick")
    assert len(pick) == 5 + 6 + 7 + 8
    assert "2 of 6 episodes dropped: their frames are of several tasks (episode 4, 5)" in pick.notes
    assert "0 of 6 episodes dropped: of another task than 'pick'" in pick.notes
    assert len(Dataset.from_lerobot(folder, **rule, task="all")) == sum(range(5, 11))


def test_what_says_that_it_terminated_is_believed(tmp_path):
    """Of six episodes two are successes, one falls, three are cut off."""
    given, rule = episodes(simulated=True), {**STATE}
    for i, one in enumerate(given):
        end = one["next.done"]
        one |= {"next.terminated": end & (i in (0, 2, 3)), "next.truncated": end & (i not in (0, 2, 3)), "next.success": end & (i in (0, 2))}
    read = {}
    for left_out in [(), ("next.done",), ("next.truncated",), ("next.terminated",), ("next.success",), ("next.success", "next.done"),
                     ("next.success", "next.terminated")]:
        folder = tmp_path / "-".join(["without", *left_out])
        read[left_out] = Dataset.from_lerobot(write(folder, [{k: v for k, v in one.items() if k not in left_out} for one in given]), **rule)
    for dataset in read.values():
        actual = rows(dataset)
        for array, by_hand in zip((actual[0], actual[1], actual[3], actual[4]), expected(given, {0, 2, 3})):
            assert np.array_equal(array, by_hand)
        assert actual[5].sum() == 3
        assert "3 of 6 episodes terminate, as next.terminated says; the others are cut off" in dataset.notes
    asked = Dataset.from_lerobot(tmp_path / "without", **rule, terminate="success")
    assert rows(asked)[4].sum() == 2


def test_what_is_broken_is_left_out_and_counted(tmp_path):
    rule = {**STATE, "reward": "step-cost", "success": "all"}
    folder = write(tmp_path / "data", episodes(), lengths={1: 99})
    last = folder / "data/chunk-001/file-000.parquet"
    last.write_bytes(last.read_bytes()[:-200])  # Without its footer.
    dataset = Dataset.from_lerobot(folder, **rule)
    assert len(dataset) == 5 + 7 + 8
    assert "1 of 6 episodes dropped: frames are missing or there twice (episode 1)" in dataset.notes
    assert any(note.startswith("2 of 6 episodes dropped: unreadable, as files are of recordings") and note.endswith("file-000.parquet")
               for note in dataset.notes)
    short = Dataset.from_lerobot(write(tmp_path / "short", episodes(), lengths={1: 0, 2: 5}), **rule)
    assert len(short) == sum(range(5, 11))
    assert ("2 of 6 episodes: meta/episodes is wrong about their frames, which are all read (episode 1: 0, but data has 6; "
            "episode 2: 5, but data has 7)") in short.notes
    for file in (folder / "data").glob("**/*.parquet"):
        file.write_bytes(b"PAR1")
    with pytest.raises(ValueError, match="no Parquet file in data has episode_index and frame_index; unreadable"):
        Dataset.from_lerobot(folder, **rule)


def test_what_cannot_be_is_refused(tmp_path):
    folder = write(tmp_path / "data", episodes())
    for message, asked in {
        "no rewards were recorded, and nothing says what is rewarded\nhint: reward=.*; success=": {},
        "reward='success-at-end' needs to know which episodes are successes": {"reward": "success-at-end"},
        "there is no column 'observation.speed'\nhint: there are 'observation.state'": {
            "observations": ["observation.speed"], "reward": "step-cost", "success": "all"},
        "observation.images.top is video": {"observations": ["observation.images.top"]},
        "observations and actions are lists": {"observations": "observation.state", "reward": "step-cost", "success": "all"},
        r"success names episodes that are not there: \[9\]": {"reward": "step-cost", "success": [9]},
        "success has 1 flags, but there are 6 episodes": {"reward": "step-cost", "success": [True]},
    }.items():
        with pytest.raises(ValueError, match=message):
            Dataset.from_lerobot(folder, **{**STATE, **asked})
    table = pq.read_table(folder / "data/chunk-000/file-000.parquet")
    pq.write_table(table.set_column(1, "action", [[None] * len(table)]), folder / "data/chunk-000/file-000.parquet")
    with pytest.raises(ValueError, match=r"column 'action', row 0 is empty \(11 such numbers\)"):
        Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all")
    info = json.loads((folder / "meta/info.json").read_text())
    (folder / "meta/info.json").write_text(json.dumps({**info, "codebase_version": "v1.6"}))
    with pytest.raises(ValueError, match="of v1.6, but v2.x and v3.x are read"):
        Dataset.from_lerobot(folder, **STATE)
    with pytest.raises(ValueError, match="no LeRobot dataset"):
        Dataset.from_lerobot(tmp_path, **STATE)


def test_a_shift_is_suspected_only_where_all_successes_have_it(tmp_path):
    given = episodes(simulated=True)
    for one in given:
        one["next.reward"] = np.zeros(len(one["action"]))
        one["next.reward"][-1] = 1.0
    given[0]["next.reward"] = np.roll(given[0]["next.reward"], -1)
    assert "shifted" not in "\n".join(Dataset.from_lerobot(write(tmp_path / "data", given), **STATE).notes)


def test_texts_may_have_ends_of_lines_of_their_own(tmp_path):
    task = "pick\u2028and place\x85"  # As LeRobot writes them.
    folder = write(tmp_path / "data", [one | {"task": task} for one in episodes()], "v2.1")
    for path in (folder / "meta").glob("*.jsonl"):
        lines = [json.dumps(json.loads(line), ensure_ascii=False) for line in path.read_text().split("\n")[:-1]]
        path.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
    assert len(Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all", task=task)) == sum(range(5, 11))


def test_names_may_be_given_by_their_places(tmp_path):
    folder = write(tmp_path / "data", episodes())
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["action"]["names"] = {"lift": 1, "pan": 0}
    (folder / "meta/info.json").write_text(json.dumps(info))
    dataset = Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all")
    assert dataset.action_names == ["action.pan", "action.lift"]


def test_episodes_that_meta_does_not_list_are_left_out_and_splits_are_told(tmp_path):
    folder = write(tmp_path / "data", episodes(), "v2.1")
    listed = (folder / "meta/episodes.jsonl").read_text().splitlines(keepends=True)
    (folder / "meta/episodes.jsonl").write_text("".join(listed[1:4]))
    info = json.loads((folder / "meta/info.json").read_text()) | {"total_episodes": 3, "splits": {"train": "0:2", "val": "2:3"}}
    (folder / "meta/info.json").write_text(json.dumps(info))
    dataset = Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all")
    assert len(dataset) == 6 + 7 + 8
    told = "\n".join(dataset.notes)
    assert "3 of 6 episodes dropped: meta/episodes does not list them, as if they were taken out (episode 0, 4, 5)" in told
    assert "meta/info.json has splits (train 0:2, val 2:3); all are read" in told and "their rows are in no file" not in told


def test_names_that_repeat_get_their_keys_or_are_refused(tmp_path):
    folder = write(tmp_path / "data", episodes())
    for names, called in ({"left": ["j"], "right": ["j"]}, ["action.left.j", "action.right.j"]), (["g", "g"], None):
        info = json.loads((folder / "meta/info.json").read_text())
        info["features"]["action"]["names"] = names
        (folder / "meta/info.json").write_text(json.dumps(info))
        if called:
            assert Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all").action_names == called
        else:
            with pytest.raises(ValueError, match="several numbers of an observation or an action are called 'action.g'\nhint: "):
                Dataset.from_lerobot(folder, **STATE, reward="step-cost", success="all")
