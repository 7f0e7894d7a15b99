"""Data of robomimic, Minari, OGBench and d3rlpy, each beside what its own library or its keys say."""

import json
import subprocess
from types import SimpleNamespace

import gymnasium
import h5py
import numpy as np
import pytest

from quad_rl import Dataset


def rows(dataset):
    return [np.array(array) for array in dataset._rows]


@pytest.fixture
def demonstrations(tmp_path):
    """Twelve demonstrations, in an order that is not the alphabet's; the last four do not succeed."""
    rng, path = np.random.default_rng(0), tmp_path / "low_dim.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(12):
            steps, won = 4 + i, i < 8
            demo = file.create_group(f"data/demo_{i}")
            end = np.arange(steps) == steps - 1
            demo["actions"], demo["dones"] = rng.uniform(-1, 1, (steps, 3)), (end & won).astype(int)
            demo["rewards"], demo["states"] = (end & won).astype(float), rng.normal(size=(steps, 9))
            for key, width in {"object": (2,), "eef_pos": (3,), "agentview_image": (8, 8, 3)}.items():
                seen = rng.normal(size=(steps + 1, *width))
                demo[f"obs/{key}"], demo[f"next_obs/{key}"] = seen[:-1], seen[1:]
        file["mask/train"] = np.array([f"demo_{i}" for i in range(10)], dtype="S8")
    return path


def test_robomimic(demonstrations):
    seen = {"observations": ["eef_pos", "object"]}
    dataset = Dataset.from_robomimic(demonstrations, **seen, filter="train")
    actual = rows(dataset)
    with h5py.File(demonstrations) as file:
        demos = [file[f"data/demo_{i}"] for i in range(10)]
        beside = [np.concatenate([np.concatenate([d[part][key] for key in seen["observations"]], 1) for d in demos])
                  for part in ("obs", "next_obs")]
        by_hand = [beside[0], np.concatenate([d["actions"] for d in demos]), np.concatenate([d["rewards"] for d in demos]), beside[1],
                   np.concatenate([d["dones"] for d in demos]) > 0]
    assert all(np.array_equal(array, np.asarray(keys, array.dtype)) for array, keys in zip(actual, by_hand))
    assert actual[5].sum() == 2 and dataset.observation_names[2:] == ["eef_pos[2]", "object[0]", "object[1]"]
    assert dataset.notes == ["2 of 12 episodes left out: not in 'train'", "left out: 1 streams of images (agentview_image)"]

    with h5py.File(demonstrations, "a") as file:
        for demo in file["data"].values():
            demo["dones"][-1] = 1  # --done_mode 1 or 2.
            del demo["next_obs"]
    with pytest.raises(ValueError, match="have dones without a success, as at a time limit: nothing says"):
        Dataset.from_robomimic(demonstrations, **seen)
    cut = Dataset.from_robomimic(demonstrations, **seen, success="rewards")
    assert rows(cut)[4].sum() == 8 and len(cut) == sum(range(4, 16)) - 4
    assert "4 of 12 episodes have dones without a success, as at a time limit: they count as cut off" in cut.notes
    for message, asked in {"no filter 'test'\nhint: there are train": {"filter": "test"},
                           "agentview_image holds images": {"observations": ["agentview_image"]},
                           "no column 'eef'\nhint: there are ": {"observations": ["eef"], "success": "all"}}.items():
        with pytest.raises(ValueError, match=message):
            Dataset.from_robomimic(demonstrations, **{**seen, **asked})


def test_robomimic_s_next_observations_are_the_following_rows(demonstrations):
    """Else what was left out between two rows would be learned as one step."""
    seen = {"observations": ["eef_pos", "object"]}
    right = Dataset.from_robomimic(demonstrations, **seen)
    with h5py.File(demonstrations, "a") as file:
        for demo in file["data"].values():
            rounded = demo["next_obs/object"][()].astype(np.float16)
            del demo["next_obs/object"], demo["next_obs/agentview_image"]
            demo["next_obs/object"] = rounded
    coarse = Dataset.from_robomimic(demonstrations, **seen)
    assert len(coarse) == len(right) and np.abs(rows(coarse)[3] - rows(right)[3]).max() < 2e-3
    with h5py.File(demonstrations, "a") as file:
        demo = file["data/demo_2"]
        demo["obs/object"][4], demo["next_obs/object"][3] = np.nan, np.nan
    with pytest.raises(ValueError, match="episode demo_2: observations, row 4: number 3 is nan"):
        Dataset.from_robomimic(demonstrations, **seen)
    with h5py.File(demonstrations, "a") as file:
        demo = file["data/demo_3"]
        for array in [demo["actions"], demo["rewards"], demo["dones"], *demo["obs"].values(), *demo["next_obs"].values()]:
            name, kept = array.name, np.delete(array[()], [2, 4], 0)
            del file[name]
            file[name] = kept
    with pytest.raises(ValueError, match=r"demo_3: next_obs, row 1 of 'eef_pos' is not the following row of obs \(2 such rows\)\nhint: "):
        Dataset.from_robomimic(demonstrations, **seen)


def test_robomimic_s_demonstrations_that_lack_something(demonstrations):
    seen = {"observations": ["eef_pos", "object"]}
    whole = Dataset.from_robomimic(demonstrations, **seen)
    with h5py.File(demonstrations, "a") as file:
        file.create_group("data/demo_12")
        demo = file.create_group("data/demo_13")
        for name, width in {"actions": (3,), "rewards": (), "dones": (), "obs/object": (2,), "obs/eef_pos": (3,)}.items():
            demo[name] = np.zeros((0, *width))
    dataset = Dataset.from_robomimic(demonstrations, **seen)
    assert all(map(np.array_equal, rows(dataset), rows(whole)))
    assert "2 of 14 episodes dropped: without a step" in dataset.notes
    with h5py.File(demonstrations, "a") as file:
        del file["data/demo_7/obs/object"], file["data/demo_9/actions"]
    for message, asked in {r"no column 'object' in episode demo_7 \(1 such episodes\)\nhint: there are 'actions', 'dones',": seen,
                           r"no column 'actions' in episode demo_9 \(1 such": {"observations": ["eef_pos"]}}.items():
        with pytest.raises(ValueError, match=message):
            Dataset.from_robomimic(demonstrations, **asked)


def test_isaac_lab_s_recorder(tmp_path):
    """Neither rewards nor dones; `obs` is one array, and an attribute says which demonstrations succeed."""
    rng, path, made = np.random.default_rng(0), tmp_path / "dataset.hdf5", []
    with h5py.File(path, "w") as file:
        for i in range(4):
            demo, seen = file.create_group(f"data/demo_{i}"), rng.normal(size=(6, 5)).astype(np.float32)
            demo["actions"], demo["obs"], demo["states/articulation/robot/joint_position"] = rng.uniform(-1, 1, (6, 2)), seen, seen
            demo.attrs["num_samples"], demo.attrs["success"] = 6, i != 2
            made.append(seen if i != 2 else seen[:-1])
    with pytest.raises(ValueError, match="no rewards were recorded, and nothing says what is rewarded\nhint: reward=.*step-cost.*success="):
        Dataset.from_robomimic(path, observations=["obs"])
    dataset = Dataset.from_robomimic(path, observations=["obs"], reward="step-cost")
    assert np.array_equal(rows(dataset)[0], np.concatenate(made)) and dataset.observation_names[0] == "obs[0]"
    assert np.flatnonzero(rows(dataset)[4]).tolist() == [5, 11, 22] and (rows(dataset)[2] == 0).sum() == 3
    assert "3 of 4 episodes are successes" in dataset.notes


def test_actions_that_are_observed_are_not_those_that_are_done(tmp_path):
    """Isaac Lab's terms of `obs` may have the action before, by the name of the action."""
    rng, path = np.random.default_rng(0), tmp_path / "dataset.hdf5"
    with h5py.File(path, "w") as file:
        for i in range(2):
            demo, done = file.create_group(f"data/demo_{i}"), rng.uniform(-1, 1, (6, 2)).astype(np.float32)
            demo["actions"], demo["obs/actions"] = done, np.concatenate([np.zeros((1, 2), np.float32), done[:-1]])
            demo["obs/eef_pos"], demo.attrs["success"] = rng.normal(size=(6, 3)), True
    dataset = Dataset.from_robomimic(path, observations=["eef_pos"], reward="step-cost")
    with h5py.File(path) as file:
        assert np.array_equal(rows(dataset)[1], np.concatenate([file[f"data/demo_{i}/actions"] for i in range(2)]))
    assert not any("come after" in note for note in dataset.notes), "success is of the whole demonstration"
    with pytest.raises(ValueError, match="'actions' is both seen, below obs, and done\nhint: "):
        Dataset.from_robomimic(path, observations=["eef_pos", "actions"], reward="step-cost")


def elsewhere(file, name, secret):
    """Ways to write an array whose numbers lie in another file."""
    with h5py.File(secret.with_suffix(".hdf5"), "w") as other:
        other["numbers"] = np.arange(20.0).reshape(5, 4)
    group, last = file[name.rsplit("/", 1)[0]], name.rsplit("/", 1)[1]
    virtual = h5py.VirtualLayout((5, 4), "f8")
    virtual[:] = h5py.VirtualSource(str(secret.with_suffix(".hdf5")), "numbers", (5, 4))
    return {
        "external storage": lambda: group.create_dataset(last, (5, 4), "u1", external=[(str(secret), 0, 20)]),
        "external link": lambda: group.__setitem__(last, h5py.ExternalLink(str(secret.with_suffix(".hdf5")), "/numbers")),
        "virtual": lambda: group.create_virtual_dataset(last, virtual),
    }


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("way", ["external storage", "external link", "virtual"])
def test_hdf5_s_arrays_of_other_files_are_refused(way, tmp_path, monkeypatch):
    """Else a dataset would be this machine's own files: whoever sends a recording would get them back with a policy."""
    (tmp_path / "secret").write_bytes(bytes(range(65, 85)))
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        demo = file.create_group("data/demo_0")
        demo["actions"], demo["rewards"], demo["dones"] = np.zeros((5, 2)), np.arange(5.0), np.arange(5) == 4
        demo.create_group("obs")
        elsewhere(file, "data/demo_0/obs/x", tmp_path / "secret")[way]()
        demo["obs/soft"] = h5py.SoftLink("/data/demo_0/obs/x")
        file["itself"] = file["/"]
    for asked in ("x", "soft"):
        with pytest.raises(ValueError, match="/data/demo_0/obs/x is not in this file: it leads to numbers that lie elsewhere\nhint: "):
            Dataset.from_robomimic(tmp_path / "demo.hdf5", observations=[asked])
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes_of_minari(BOX, lambda rng, count: list(rng.normal(size=(count, 2))), "hdf5", "sent/by-mail-v0")
    assert len(Dataset.from_minari("sent/by-mail-v0")) == 20
    with h5py.File(tmp_path / "sent/by-mail-v0/data/main_data.hdf5", "a") as file:
        del file["episode_1/actions"]
        elsewhere(file, "episode_1/actions", tmp_path / "secret")[way]()
    with pytest.raises(ValueError, match="/episode_1/actions is not in this file"):
        Dataset.from_minari("sent/by-mail-v0")


def episodes_of_minari(space, observe, storage, name, short=False):
    """Writes four episodes of five steps, by Minari; every other one terminates. Needs no jax, as its DataCollector does."""
    import minari

    rng, made, box = np.random.default_rng(0), [], gymnasium.spaces.Box(-1, 1, (2,), np.float64)
    for i in range(4):
        end = np.arange(5) == 4
        made.append(minari.data_collector.EpisodeBuffer(
            id=i, observations=observe(rng, 5 if short else 6), actions=list(rng.uniform(-1, 1, (5, 2))), rewards=list(rng.normal(size=5)),
            terminations=list(end & (i % 2 == 0)), truncations=list(end & (i % 2 > 0))))
    minari.create_dataset_from_buffers(name, made, observation_space=space, action_space=box, data_format=storage)
    return minari.load_dataset(name)


BOX = gymnasium.spaces.Box(-9, 9, (2,), np.float64)
NESTED = gymnasium.spaces.Dict(z=BOX, a=gymnasium.spaces.Dict(y=gymnasium.spaces.Tuple((BOX, BOX)), x=BOX))


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("storage", ["hdf5", "arrow", "parquet"])
def test_minari(storage, tmp_path, monkeypatch):
    """Beside `iterate_episodes` and Gymnasium's `flatten`, observations being a Dict of a Dict."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def observe(rng, count):
        draw = [list(rng.normal(size=(count, 2))) for _ in range(4)]
        return {"z": draw[0], "a": {"y": (draw[1], draw[2]), "x": draw[3]}}

    parts = []
    theirs = episodes_of_minari(NESTED, observe, storage, f"point/{storage}-v0")
    for episode in theirs.iterate_episodes():
        whole = episode.observations
        at = [{"z": whole["z"][t], "a": {"y": tuple(part[t] for part in whole["a"]["y"]), "x": whole["a"]["x"][t]}} for t in range(6)]
        flat = np.array([gymnasium.spaces.flatten(theirs.observation_space, one) for one in at])
        parts.append((flat[:-1], episode.actions, episode.rewards, flat[1:], episode.terminations, episode.truncations))
    by_hand = [np.concatenate(arrays) for arrays in zip(*parts)]
    for source in (f"point/{storage}-v0", tmp_path / f"point/{storage}-v0", tmp_path / f"point/{storage}-v0/data"):
        dataset = Dataset.from_minari(source)
        assert all(np.array_equal(array, np.asarray(right, array.dtype)) for array, right in zip(rows(dataset), by_hand))
    assert by_hand[4].sum() == 2 and by_hand[5].sum() == 2 and len(dataset) == 20 and not dataset.notes
    assert dataset.observation_names[:3] == ["observations.a.x[0]", "observations.a.x[1]", "observations.a.y.0[0]"]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_is_read_as_the_learner_reads_it(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    flat = gymnasium.spaces.Dict({"b": BOX, "a": BOX})
    episodes_of_minari(flat, lambda rng, count: {key: list(rng.normal(size=(count, 2))) for key in ("b", "a")}, "hdf5", "one/flat-v0")
    inspected = subprocess.run(["learner", "datasets", "inspect", "--json", "minari:one/flat-v0"], check=True, capture_output=True)
    ours, theirs = Dataset.from_minari("one/flat-v0").inspect(), json.loads(inspected.stdout)
    for figure in ("transitions", "episodes", "action_ranges", "reward_range", "returns", "terminals", "timeouts"):
        assert ours[figure] == theirs[figure], figure
    for column, with_last in zip(ours["observation_ranges"], theirs["observation_ranges"]):
        assert with_last["min"] <= column["min"] and column["max"] <= with_last["max"]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_without_last_observations(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    episodes_of_minari(BOX, lambda rng, count: list(rng.normal(size=(count, 2))), "hdf5", "old/short-v0", short=True)
    dataset = Dataset.from_minari("old/short-v0")
    assert len(dataset) == 5 + 4 + 5 + 4 and "2 of 4 episodes: the last step is dropped" in dataset.notes[0]


def trajectories(env, path, seed=0):
    """A file as OGBench's, of random states some of which are near the goals of the environment's tasks."""
    rng, n = np.random.default_rng(seed), 400
    unwrapped = env.unwrapped
    qpos = np.tile(unwrapped.data.qpos if hasattr(unwrapped, "data") else unwrapped._data.qpos, (n, 1))
    goals = np.array([unwrapped.ij_to_xy(task["goal_ij"]) for task in unwrapped.task_infos])
    qpos[:, :2] = goals[rng.integers(5, size=n)] + rng.normal(size=(n, 2)) * 0.6
    arrays = {"observations": rng.normal(size=(n, 4)).astype(np.float32), "actions": rng.uniform(-1, 1, (n, 2)).astype(np.float32),
              "terminals": np.arange(n) % 50 == 49, "qpos": qpos, "qvel": qpos}
    np.savez(path, **arrays)
    np.savez(str(path).replace(".npz", "-val.npz"), **{name: array[:50] for name, array in arrays.items()})


@pytest.mark.parametrize("maze", ["pointmaze-medium", "antmaze-large", "antmaze-giant"])
def test_ogbench_mazes(maze, tmp_path):
    """Beside `make_env_and_datasets`, which relabels by the environment's own goals."""
    import ogbench

    trajectories(gymnasium.make(f"{maze}-singletask-v0").unwrapped, tmp_path / f"{maze}-navigate-v0.npz")
    for task in ["", "-task1", "-task2", "-task3", "-task4", "-task5"]:
        name = f"{maze}-navigate-singletask{task}-v0"
        _, theirs, _ = ogbench.make_env_and_datasets(name, dataset_dir=str(tmp_path))
        actual = rows(Dataset.from_ogbench(name, folder=tmp_path))
        keys = ("observations", "actions", "rewards", "next_observations")
        assert all(np.array_equal(array, theirs[key]) for array, key in zip(actual, keys)), name
        assert np.array_equal(actual[4], theirs["masks"] == 0) and 10 < actual[4].sum() < 200
        assert np.array_equal(actual[4] | actual[5], (theirs["masks"] == 0) | (theirs["terminals"] > 0))


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_ogbench_soccer(tmp_path):
    import ogbench

    rng, n = np.random.default_rng(0), 60
    qpos = rng.uniform(-1, 25, (n, 22))
    arrays = {"observations": rng.normal(size=(n, 5)).astype(np.float32), "actions": rng.uniform(-1, 1, (n, 5)).astype(np.float32),
              "terminals": np.arange(n) % 20 == 19, "qpos": qpos, "qvel": qpos}
    arrays["qpos"][::3, 15:17] = gymnasium.make("antsoccer-arena-singletask-task2-v0").unwrapped.task_infos[1]["goal_xy"]
    for part in ("", "-val"):
        np.savez(tmp_path / f"antsoccer-arena-navigate-v0{part}.npz", **arrays)
    name = "antsoccer-arena-navigate-singletask-task2-v0"
    _, theirs, _ = ogbench.make_env_and_datasets(name, dataset_dir=str(tmp_path))
    actual = rows(Dataset.from_ogbench(name, folder=tmp_path))
    assert np.array_equal(actual[2], theirs["rewards"]) and np.array_equal(actual[3], theirs["next_observations"])
    assert np.array_equal(actual[4], theirs["masks"] == 0) and actual[4].sum() == 19
    with pytest.raises(ValueError, match="has no rewards.*\nhint: antsoccer-arena-navigate-singletask-task1-v0"):
        Dataset.from_ogbench("antsoccer-arena-navigate-v0")


def test_d3rlpy():
    """A stand-in with the attributes that d3rlpy 2 documents: d3rlpy itself needs torch."""
    rng, episodes = np.random.default_rng(0), []
    for i in range(4):
        episodes.append(SimpleNamespace(observations=rng.normal(size=(5, 3)).astype(np.float32), rewards=rng.normal(size=(5, 1)),
                                        actions=rng.uniform(-1, 1, (5, 2)), terminated=i % 2 == 0))
    actual = rows(Dataset.from_d3rlpy(SimpleNamespace(episodes=episodes)))
    assert len(actual[2]) == 5 + 4 + 5 + 4 and np.flatnonzero(actual[4]).tolist() == [4, 13]
    assert np.array_equal(actual[2][5:9], episodes[1].rewards[:4, 0].astype(np.float32))
    assert np.array_equal(actual[3][5:9], episodes[1].observations[1:])
    with pytest.raises(ValueError, match="tuples"):
        Dataset.from_d3rlpy(SimpleNamespace(episodes=[SimpleNamespace(observations=(episodes[0].observations,))]))
    episodes[0].actions = np.zeros((5, 1), int)
    with pytest.raises(ValueError, match="integers"):
        Dataset.from_d3rlpy(SimpleNamespace(episodes=episodes[:1]))


def test_robomimics_flags_are_in_the_order_of_its_numbers(demonstrations):
    by_flags, by_rewards = (Dataset.from_robomimic(demonstrations, observations=["object"], success=success)
                            for success in ([i < 8 for i in range(12)], "rewards"))
    with h5py.File(demonstrations) as file:
        actions = np.concatenate([file[f"data/demo_{i}/actions"] for i in range(12)])
    assert np.array_equal(rows(by_flags)[1], actions.astype(np.float32))
    assert np.array_equal(rows(by_flags)[4], rows(by_rewards)[4])


def test_images_of_one_color_are_images():
    from quad_rl.readers.minari import _parts

    for shape in [(5, 8, 8), (5, 8, 8, 3)]:
        with pytest.raises(ValueError, match="holds images"):
            _parts("observations", None, np.zeros(shape, np.uint8))
