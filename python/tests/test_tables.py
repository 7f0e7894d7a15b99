"""Tables of any kind, quad-convert, and the names that go from a table into the policy."""

import json
import re
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from conftest import train
from lerobot_folder import episodes, write

from quad_rl import Dataset, Policy, _convert
from quad_rl._extras import EXTRAS

COLUMNS = {"observations": ["x", "v"], "actions": ["torque"], "episode": "run"}


def table(runs=("b", "a", "c"), steps=20, seed=0):
    rng, rows = np.random.default_rng(seed), len(runs) * steps
    columns = {"x": rng.normal(3, 2, rows), "v": rng.normal(size=rows), "torque": rng.uniform(-40, 40, rows), "gain": rng.normal(size=rows)}
    return pd.DataFrame({**columns, "run": np.repeat(runs, steps), "fell": np.arange(rows) == steps - 1})


def rows(dataset):
    return [np.array(array) for array in dataset._rows]


def test_a_table_of_any_kind_makes_the_same_transitions(tmp_path):
    frame = table()
    arrays = {"observations": frame[["x", "v"]], "actions": frame[["torque"]], "rewards": frame["gain"]}
    ends = np.arange(60) % 20 == 19
    right = rows(Dataset.from_arrays(**arrays, terminations=frame["fell"], truncations=ends & ~frame["fell"]))
    frame.to_csv(tmp_path / "log.csv", index=False)
    frame.to_csv(tmp_path / "log.tsv", index=False, sep="\t")
    frame.to_csv(tmp_path / "semicolons.csv", index=False, sep=";")
    frame.to_parquet(tmp_path / "log.parquet", row_group_size=7)
    exact = pa.Table.from_pandas(frame).set_column(0, "x", pa.array(frame["x"]).cast(pa.decimal128(38, 30)))
    lists = pa.Table.from_pandas(frame).append_column("both", pa.array(list(frame[["x", "v"]].to_numpy())))
    for source, changed in [(frame, {}), (tmp_path / "log.csv", {}), (str(tmp_path / "log.tsv"), {}), (tmp_path / "log.parquet", {}),
                            (tmp_path / "semicolons.csv", {}), (exact, {}),
                            ({name: column.to_numpy() for name, column in frame.items()}, {}), (lists, {"observations": ["both"]}),
                            (lists.to_pandas(), {"observations": ["both"]}),
                            (frame.sort_values(["fell", "run"], kind="stable").sort_index(level=0), {})]:
        dataset = Dataset.from_frame(source, **{**COLUMNS, **changed}, reward="gain", terminal="fell")
        assert all(np.array_equal(array, other) for array, other in zip(rows(dataset), right))
        assert dataset.observation_names == (["both[0]", "both[1]"] if changed else ["x", "v"])
    mixed = frame.iloc[np.argsort(np.arange(60) % 20, kind="stable")]  # Three runs, recorded at once.
    dataset = Dataset.from_frame(mixed, **COLUMNS, reward="gain", terminal="fell", apart="interleaved")
    assert all(np.array_equal(array, other) for array, other in zip(rows(dataset), right))
    assert dataset.notes[0].startswith("3 of 3 episodes: their rows do not lie together")


NAN = float("nan")


@pytest.mark.parametrize("ids", [
    [1, 1, 1, NAN, NAN, 2, 2, 2, NAN, 3, 3, 3], [*"aaa", None, None, *"bbb", None, *"ccc"], [*"aaa", "", "", *"bbb", " ", *"ccc"],
    pd.array([1, 1, 1, None, None, 2, 2, 2, None, 3, 3, 3], dtype="Int64"),
    pd.to_datetime(["2026-01-01"] * 3 + [None] * 2 + ["2026-01-02"] * 3 + [None] + ["2026-01-03"] * 3),
], ids=["numbers", "texts", "empty texts", "nullable", "times"])
def test_rows_of_no_episode_are_refused(ids, tmp_path):
    frame = pd.DataFrame({"x": np.arange(12.0), "torque": np.linspace(-1, 1, 12), "gain": 1.0, "run": ids})
    asked = {"observations": ["x"], "actions": ["torque"], "episode": "run", "reward": "gain", "terminal": "never"}
    frame.to_csv(tmp_path / "log.csv", index=False)
    for source in (frame, {name: column.to_numpy() for name, column in frame.items()}, tmp_path / "log.csv"):
        with pytest.raises(ValueError, match=r"column 'run', row 3 is empty.* \(3 such "):
            Dataset.from_frame(source, **asked)
    assert len(Dataset.from_frame(frame[frame["run"].astype(str).str.len() > 0].dropna().replace(" ", pd.NA).dropna(), **asked)) == 6


def test_rows_of_an_episode_that_lie_apart_are_asked_about():
    """Two logs with the same numbers, or two runs at once: the table itself does not tell."""
    frame = pd.DataFrame({"x": [0.0, 1, 2, 3, 4, 100, 101, 102], "torque": np.linspace(-1, 1, 8), "gain": 1.0,
                          "run": [1, 1, 1, 2, 2, 1, 1, 1], "won": [0, 0, 1, 0, 0, 0, 0, 0]})
    asked = {"observations": ["x"], "actions": ["torque"], "episode": "run", "reward": "gain"}
    with pytest.raises(ValueError, match="1 of 2 episodes: their rows do not lie together, as those of 'run' 1\nhint: apart="):
        Dataset.from_frame(frame, **asked, terminal="never")
    with pytest.raises(ValueError, match="apart is 'both'"):
        Dataset.from_frame(frame, **asked, terminal="never", apart="both")
    once = Dataset.from_frame(frame, **asked, terminal="never", apart="interleaved")
    assert (once._rows.observations[:, 0].tolist(), once._rows.next_observations[:, 0].tolist()) == ([0, 1, 2, 100, 101, 3], [1, 2, 100, 101, 102, 4])
    again = Dataset.from_frame(frame, **asked, success="won", apart="repeated")
    assert (again._rows.observations[:, 0].tolist(), again._rows.next_observations[:, 0].tolist()) == ([0, 1, 2, 3, 100, 101], [1, 2, 2, 4, 101, 102])
    assert again._rows.terminals.tolist() == [False, False, True, False, False, False]
    assert "1 of 2 names are those of several episodes: 3 in all" in again.notes
    with pytest.raises(ValueError, match="names, of which some are those of several episodes"):
        Dataset.from_frame(frame, **asked, success=[1], apart="repeated")


def test_what_a_table_lacks_is_asked_for(tmp_path):
    frame, rule = table(), {**COLUMNS, "reward": "step-cost"}
    by_name = Dataset.from_frame(frame, **rule, success=["a"])
    assert by_name._rows.terminals.sum() == 1 and by_name._rows.rewards[38] == 0 and by_name._rows.rewards.sum() == -57
    assert "no episode terminates" in Dataset.from_frame(frame, **{**rule, "reward": "gain"}).notes[0]
    done = Dataset.from_frame(frame.rename(columns={"fell": "Done"}), **{**rule, "reward": "gain"})
    assert done.notes[0] == "no terminal is given: 'Done', if that says where the task was over?"
    holes = frame.assign(x=frame["x"].where(np.arange(60) != 33))
    holes.to_parquet(tmp_path / "holes.parquet")
    for message, source, asked in [
        ("column 'x', row 33 is empty", tmp_path / "holes.parquet", {**rule, "success": "all"}),
        ("episode a: observations, row 13: number 0 is nan", holes, {**rule, "success": "all"}),
        ("there is no column 'run' for episodes\nhint: there are 'x', 'v'", frame.drop(columns="run"), rule),
        ("no column 'y'\nhint: there are 'x', 'v', 'torque', 'gain', 'run', 'fell'", frame, {**rule, "observations": ["y"], "success": "all"}),
        ("column 'run', row 0 of episode b holds 'b' in place of a number\nhint: ", frame, {**rule, "observations": ["run"], "success": "all"}),
        ("\nhint: success= a column", frame, rule),
        ('hint: terminal="success", or rewards', frame, {**rule, "success": "all", "terminal": "never"}),
        ("there is no episode", frame[:0], {**rule, "success": "all"}),
        (r"the table: x, row 3 is masked \(1 such rows\)\nhint: leave",
         {**frame, "x": np.ma.masked_array(frame["x"], np.arange(60) == 3)}, {**rule, "success": "all"}),
        ("column 'fell', row 1 of episode b holds '<NA>' in place of a number\nhint: numbers are written like 0.5", frame.assign(fell=pd.array([True, None] * 30, "boolean")),
         {**rule, "reward": "gain", "terminal": "fell"}),
        ("column 'x', row 13 of episode a holds '-' in place of a number", frame.assign(x=frame["x"].astype(str).where(np.arange(60) != 33, "-")),
         {**rule, "success": "all"}),
        ("observations and actions are lists of columns, of one at least", frame, {**rule, "actions": [], "success": "all"}),
        ("the table has several columns 'x'", pd.concat([frame, frame[["x"]]], axis=1), {**rule, "success": "all"}),
        ("the table: column 'x' has 61 rows, but 'run' has 60", {**frame, "x": np.zeros(61)}, {**rule, "success": "all"}),
        ("the table: column 'x' has lists of several lengths", frame.assign(x=[[1.0, 2.0], [1.0]] * 30), {**rule, "success": "all"}),
        ("episode b: terminations, row 4: 0.5 is neither 0 nor 1", frame.assign(fell=np.arange(60) == 4).assign(fell=lambda f: f["fell"] / 2),
         {**rule, "reward": "gain", "terminal": "fell"}),
    ]:
        with pytest.raises(ValueError, match=message):
            Dataset.from_frame(source, **asked)


def test_a_table_without_a_line_of_names(tmp_path):
    table().to_csv(tmp_path / "log.csv", index=False, header=False)
    with pytest.raises(ValueError, match="log.csv has no line of names: its first line is .*, b, False\nhint: write one above them, such as x,v,torque,run"):
        Dataset.from_frame(tmp_path / "log.csv", **COLUMNS, reward="gain", terminal="fell")
    frame = pd.DataFrame(table()[["x", "v", "torque", "gain", "run"]].to_numpy())  # Its own columns are numbers.
    frame.to_csv(tmp_path / "numbers.csv", index=False)
    for source in (tmp_path / "numbers.csv", frame):
        read = Dataset.from_frame(source, observations=["0", "1"], actions=["2"], episode="4", reward="3", terminal="never")
        assert read.observation_names == ["0", "1"] and len(read) == 57
    with pytest.raises(ValueError, match="there is no column 'x'"):
        Dataset.from_frame(tmp_path / "numbers.csv", observations=["x"], actions=["2"], episode="4", reward="3", success="all")


@pytest.mark.parametrize("name, cut", [("log.csv", 9), ("log.parquet", 100)])
def test_a_table_that_is_still_being_written_is_named(tmp_path, name, cut):
    table().to_csv(tmp_path / "log.csv", index=False)
    table().to_parquet(tmp_path / "log.parquet")
    part = tmp_path / f"part-{name}"
    part.write_bytes((tmp_path / name).read_bytes()[:-cut])
    with pytest.raises(ValueError, match=rf"(?s)part-{name} is no whole CSV or Parquet file: .*\nhint: its"):
        Dataset.from_frame(part, **COLUMNS, reward="gain", terminal="fell")


@pytest.mark.parametrize("encoding", ["latin-1", "utf-16"])
def test_a_table_in_another_encoding_is_named(tmp_path, capsys, encoding):
    table().rename(columns={"gain": "größe"}).to_csv(tmp_path / "log.csv", index=False, encoding=encoding)
    words = [*COLUMNS["observations"], "--actions", "torque", "--episode", "run", "--reward", "größe", "--out", str(tmp_path / "out.hdf5")]
    assert _convert.main([str(tmp_path / "log.csv"), "--observations", *words]) == 1
    said = capsys.readouterr().err
    assert "log.csv is no whole CSV or Parquet file: " in said and "a CSV file is in UTF-8" in said


def test_whole_numbers_are_actions_if_they_are_said_to_be():
    frame = table().assign(torque=np.random.default_rng(0).integers(-20, 20, 60))
    asked = {**COLUMNS, "reward": "gain", "terminal": "fell"}
    with pytest.raises(ValueError, match=r"actions are integers, .*\nhint: pass amounts, .*astype\(float\).* continuous=True, quad-convert --continuous"):
        Dataset.from_frame(frame, **asked)
    right = Dataset.from_frame(frame.astype({"torque": float}), **asked)
    assert all(map(np.array_equal, rows(Dataset.from_frame(frame, **asked, continuous=True)), rows(right)))


def test_many_rows_after_a_success_are_told():
    frame = table().assign(won=np.arange(60) % 20 >= 2)
    told = Dataset.from_frame(frame, **COLUMNS, reward="gain", success="won").notes
    assert any(note.startswith("51 of 60 rows (85%) come after their episode's first won, as if the task went on: ") for note in told), told
    frame["won"] = np.arange(60) % 20 >= 18
    assert not any("come after" in note for note in Dataset.from_frame(frame, **COLUMNS, reward="gain", success="won").notes)


@pytest.mark.parametrize("unit", [1, "datetime64[ns]"])
def test_clocks_and_what_they_say_of_the_rows_are_told(unit):
    frame, time = table(), 0.02 * (np.arange(60) % 20)
    time[10:20] += 0.6
    time[31] = time[30]
    time[50], time[51] = time[51], time[50]
    frame["time"] = time if unit == 1 else (1_760_000_000 + time) * np.timedelta64(1_000_000_000, "ns") + np.datetime64(0, "ns")
    frame["stamp"], frame["lifetime"], frame["frame_index"] = "none", frame["x"], np.arange(60) % 20
    rule = {**COLUMNS, "reward": "gain", "terminal": "fell"}
    assert Dataset.from_frame(frame, **rule).notes[0] == (
        "of 57 steps, by their 'time', 4 take more than 1.5 times the usual 0.02, up to 0.62, as if rows were missing: begin another "
        "episode there; 1 take no time, as if rows were there twice; 1 go back: sort the rows")
    every = Dataset.from_frame(frame.drop(columns=["time", "stamp"]), **{**rule, "observations": ["*"]})
    assert every.observation_names == ["x", "v", "lifetime", "frame_index"], "nothing that has another role"
    assert every.notes[0].startswith("2 of 3 episodes: the last step") and every.notes[1:] == [
        "frame_index: grows by about the same in each step, as a clock does; leave it out of the observations, unless what to do depends "
        "on the time"]


def test_a_folder_has_an_episode_a_file(tmp_path):
    frame = table().assign(v=np.arange(60) % 20)
    for name, part in frame.drop(columns="run").groupby(frame["run"]):
        part.assign(v=part["v"] + (name == "b") / 2).to_csv(tmp_path / f"{name}.csv", index=False)
    read = Dataset.from_frame(tmp_path, **{**COLUMNS, "episode": "file"}, reward="gain", terminal="fell")
    right = Dataset.from_frame(frame.assign(v=frame["v"] + (frame["run"] == "b") / 2).sort_values("run", kind="stable"), **COLUMNS,
                               reward="gain", terminal="fell")
    assert all(map(np.array_equal, rows(read), rows(right)))
    pd.DataFrame({"x": [1.0], "note": "calibrated"}).to_csv(tmp_path / "notes.csv", index=False)
    with pytest.raises(ValueError, match="column 'v' is missing or has empty places in 1 of the files, such as 'notes'"):
        Dataset.from_frame(tmp_path, **{**COLUMNS, "episode": "file"}, reward="gain", terminal="fell")


def test_names_go_into_the_file_and_the_policy(snapshots, tmp_path):
    frame = table(steps=60)
    Dataset.from_frame(frame, **COLUMNS, reward="gain", terminal="fell").save(tmp_path / "log.hdf5")
    with h5py.File(tmp_path / "log.hdf5") as file:
        assert list(file.attrs["observation_names"]) == ["x", "v"] and list(file.attrs["action_names"]) == ["torque"]
    inspected = subprocess.run(["learner", "datasets", "inspect", "--json", tmp_path / "log.hdf5"], capture_output=True)
    assert json.loads(inspected.stdout)["observation_names"] == ["x", "v"]
    snapshot = train(tmp_path / "run", tmp_path / "log.hdf5", "--task", "own-data", "--env", "mine", "--steps", "2", "--normalize",
                     "actions,observations")
    policy = Policy.load(snapshot)
    assert (policy.observation_names, policy.action_names) == (["x", "v"], ["torque"])
    seen = frame[["x", "v"]]
    assert np.array_equal(policy.act(seen, seed=1), policy.act(seen.to_numpy(), seed=1))
    numbers = {"odometer": np.full(180, NAN), **{name: seen[name].to_numpy() for name in ("v", "x")}}
    assert np.array_equal(policy.act(seen, seed=1), policy.act(numbers, seed=1))
    others = {"odometer": NAN, "robot": "mine", "camera": np.zeros((4, 6, 3), np.uint8)}
    one = {"v": float(seen["v"][0]), "x": float(seen["x"][0]), **others}
    assert np.array_equal(policy.act(one, seed=1), policy.act(seen.to_numpy()[0], seed=1))
    assert np.array_equal(policy.begin(7).act(one), policy.act(seen.to_numpy()[0], seed=7))
    assert np.array_equal(policy.value(one, {"torque": 3.0}), policy.value(seen.to_numpy()[0], [3.0]))
    for message, wrong in {"observations lacks x; it has v": {"v": 1.0}, r"number 1 \(v\) is NaN": {"v": NAN, "x": 1.0}}.items():
        with pytest.raises(ValueError, match=message):
            policy.act(wrong)
    with pytest.raises(ValueError, match="is a dictionary, but the policy's data has no names\nhint: "):
        Policy.load(snapshots["iql"]).act({"x": 1.0})
    twice = Policy.from_bytes(snapshot.read_bytes().replace(b'[\\"x\\",\\"v\\"]', b'[\\"x\\",\\"x\\"]'))
    assert twice.observation_names == ["x", "x"]
    with pytest.raises(ValueError, match="is a dictionary, but the policy's data has several columns \"x\"\nhint: give its numbers in its order"):
        twice.act({"x": 1.0})
    for act in (policy.act, policy.begin(list(range(180))).act, policy.sample):
        with pytest.raises(ValueError, match="has the columns v, x, but the policy takes, in this order, x, v"):
            act(frame[["v", "x"]])
    with pytest.raises(ValueError, match=r"actions has the columns gain, but the policy takes, in this order, torque"):
        policy.value(seen, frame[["gain"]])
    with pytest.raises(ValueError, match=r"has shape \[180, 3\], but must have \[n, 2\] or \[2\]: x, v"):
        policy.act(np.zeros((180, 3)))


def test_quad_convert_reads_what_python_reads(tmp_path, capsys, monkeypatch):
    def convert(*words):
        status = _convert.main([*map(str, words), "--out", str(tmp_path / "out.hdf5")])
        said = capsys.readouterr()
        return status, said.err if status else said.out

    folder = write(tmp_path / "lerobot", episodes())
    status, page = convert(folder, "--observations", "observation.state", "--reward", "step-cost", "--success", "0", "3")
    assert status == 0 and "2 of 6 episodes are successes" in page and "--dataset " + str(tmp_path / "out.hdf5") in page
    Dataset.from_lerobot(folder, observations=["observation.state"], reward="step-cost", success=[0, 3]).save(tmp_path / "python.hdf5")
    assert (tmp_path / "out.hdf5").read_bytes() == (tmp_path / "python.hdf5").read_bytes()
    table().to_csv(tmp_path / "log.csv", index=False)
    log = [tmp_path / "log.csv", "--observations", "x", "v", "--actions", "torque", "--episode", "run"]
    assert convert(*log, "--reward", "gain", "--terminal", "fell")[0] == 0
    assert convert(*log, "--reward", "step-cost", "--success", "a", "b")[0] == 0
    assert "1 of 3 episodes are successes" in convert(*log, "--reward", "step-cost", "--success", "a")[1]
    (tmp_path / "folder").mkdir()
    [table().to_csv(tmp_path / f"folder/{name}.csv", index=False) for name in ("1", "2", "007")]
    files = [tmp_path / "folder", *log[1:-1], "file", "--reward", "step-cost", "--success"]
    assert all(f"{len(names)} of 3 episodes are successes" in convert(*files, *names)[1] for names in (["1", "2"], ["007"], ["1"]))
    assert "episodes that are not there: ['7']" in convert(*files, "7", "1")[1]
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        seen = np.random.default_rng(0).uniform(-1, 1, (10, 5))
        file["data/demo_0/obs/object"], file["data/demo_0/next_obs/object"], file["data/demo_0/actions"] = seen[:-1, 2:], seen[1:, 2:], seen[1:, :2]
        file["data/demo_0/rewards"] = file["data/demo_0/dones"] = np.arange(9) == 8
    assert convert(tmp_path / "demo.hdf5", "--observations", "object")[0] == 0
    with h5py.File(tmp_path / "demo.hdf5", "a") as file:
        file["data/demo_0/gripper"] = np.linspace(-1, 1, 9)
    assert convert(tmp_path / "demo.hdf5", "--observations", "object", "--actions", "actions", "gripper")[0] == 0
    with h5py.File(tmp_path / "out.hdf5") as file:
        assert list(file.attrs["action_names"]) == ["actions[0]", "actions[1]", "gripper"]
        assert np.array_equal(file["actions"][:, 2], np.linspace(-1, 1, 9, dtype=np.float32))
    whole = table().assign(torque=np.arange(60) % 7 - 3)
    pd.concat([whole, whole]).to_csv(tmp_path / "log.csv", index=False)
    for told, words in {"quad-convert --continuous": [], "(quad-convert --apart)": ["--continuous"]}.items():
        status, said = convert(*log, "--reward", "gain", "--terminal", "fell", *(words or ["--apart", "repeated"]))
        assert status == 1 and told in said, said
    status, page = convert(*log, "--reward", "step-cost", "--success", "all", "--continuous", "--apart", "repeated")
    assert status == 0 and "3 of 3 names are those of several episodes: 6 in all" in page
    assert "--normalize actions" in page and "6 of 6 episodes are successes" in page, "what the inspection doubts is shown, too"

    def no_network(names, folder):
        raise OSError("no network")

    monkeypatch.setattr("ogbench.download_datasets", no_network)
    (tmp_path / "empty").mkdir()
    (tmp_path / "log.mcap").write_bytes(b"\x89MCAP0\r\n\x01\0")
    np.savez(tmp_path / "maze.npz", **{name: np.zeros((4, 1)) for name in ("observations", "actions", "rewards", "terminals")})
    for message, words in {
        "needs --actions and --reward": [tmp_path / "log.csv", "--observations", "x", "--episode", "run"],
        "--task does not apply to this source": [*log, "--reward", "gain", "--task", "pick"],
        "nothing says what is rewarded": [folder, "--observations", "observation.state"],
        "there is no nothing.csv": ["nothing.csv"],
        "is the source itself": [tmp_path / "out.hdf5", "--observations", "object"],
        "a folder without Minari's main_data.hdf5": [tmp_path / "empty"],
        "an MCAP file, as ROS 2 records them": [tmp_path / "log.mcap"],
        "reads it as it is": [tmp_path / "maze.npz"],
        "reads D4RL's and your own HDF5 files as they are": [tmp_path / "python.hdf5", "--observations", "object"],
        "has no rewards": ["ogbench:cube-double-play-v0"],
        "hint: put it and antmaze-giant-navigate-v0-val.npz there": ["ogbench:antmaze-giant-navigate-singletask-v0", "--folder", tmp_path],
        "OGBench has no task none-huge-singletask-v0": ["ogbench:none-huge-singletask-v0", "--folder", tmp_path],
    }.items():
        status, said = convert(*words)
        assert status == 1 and said.startswith("quad-convert: ") and message in said, said


def test_one_command_trains_on_a_log_without_rewards_and_goes_on(tmp_path, monkeypatch, capsys):
    log = table(steps=60).drop(columns="gain").rename(columns={"x": "q1", "v": "q2", "torque": "u1"})
    log.to_csv(tmp_path / "log.csv", index=False)
    words = ["log.csv", "--observations", "q2", "q*", "--actions", "u*", "--episode", "run", "--reward", "none", "--out", "robot.hdf5",
             "--train", "--steps", "100000000", "--set", "batch_size=32", "--agent", "actor={hidden=[16]}"]
    monkeypatch.chdir(tmp_path)

    def interrupted():
        """Its log until a Ctrl-C ends it."""
        process = subprocess.Popen([Path(sys.executable).parent / "quad-convert", *words], stderr=subprocess.PIPE, text=True)
        said = [process.stderr.readline()]
        while "its metrics at" not in said[-1]:
            assert said[-1], said
            said.append(process.stderr.readline())
        process.send_signal(signal.SIGINT)
        said.append(process.communicate(timeout=600)[1])
        assert process.returncode == 75, said
        return "".join(said)

    said = interrupted()
    assert "diffusion-policy; seed 0" in said and "`--algorithm diffusion-policy` clones without rewards" in said
    assert "runs/own-data-diffusion-policy-seed0 continues after step " in interrupted()
    with h5py.File(tmp_path / "robot.hdf5") as file:
        assert list(file.attrs["observation_names"]) == ["q2", "q1"] and list(file.attrs["action_names"]) == ["u1"]
        assert len(file["rewards"]) == 177 and not np.any(file["rewards"])
    config = tomllib.loads((tmp_path / "runs/own-data-diffusion-policy-seed0/config.toml").read_text())
    assert config["experiment"]["normalize"] == ["actions", "observations"]

    own = ["--task", "mine", "--normalize=rewards", "--algorithm", "iql"]
    assert _convert._training(own, "none") == own
    (tmp_path / "robot.hdf5").unlink()
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    assert _convert.main(words) == 1 and not (tmp_path / "robot.hdf5").exists()
    assert capsys.readouterr().err.startswith("quad-convert: there is no program `learner` in ")


MISSING = {
    "pyarrow.parquet": ("lerobot", "Dataset.from_lerobot('lerobot', observations=['observation.state'], reward='step-cost', success='all')"),
    "pyarrow": ("table", "Dataset.from_frame('log.csv', observations=['x'], actions=['x'], reward='x', episode='run')"),
    "h5py": ("robomimic", "Dataset.from_robomimic('demo.hdf5', observations=['object'])"),
    "minari": ("minari", "Dataset.from_minari('mujoco/hopper/medium-v0')"),
    "PIL": ("minari", "Dataset.from_minari('mujoco/hopper/medium-v0')"),
    "ogbench": ("ogbench", "Dataset.from_ogbench('cube-single-play-singletask-v0', folder='.')"),
    "gymnasium": ("gymnasium", "_evaluate._Gymnasium('Hopper-v5')(0)"),
    "onnx": ("onnx", "export_onnx('policy.safetensors', 'policy.onnx')"),
}


@pytest.mark.parametrize("module", MISSING)
def test_a_library_that_is_missing_is_named_with_its_extra(module, tmp_path):
    write(tmp_path / "lerobot", episodes())
    (tmp_path / "log.csv").write_text("x,run\n1,2\n")
    extra, call = MISSING[module]
    code = f"import sys; sys.modules[{module!r}] = None; import quad_rl; quad_rl.{call}"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600, cwd=tmp_path).stderr
    assert "ImportError: " in said and "hint: pip install " in said and f"the extra '{extra}' of quad-rl" in said, said


def test_extras_are_what_the_hints_say():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    declared = {extra: [re.split("[>=]", package)[0] for package in packages]
                  for extra, packages in project["optional-dependencies"].items()}
    assert declared == EXTRAS


def test_episodes_keep_their_names_and_their_order(tmp_path):
    frame = table(runs=("b", "c", "a"))
    dataset = Dataset.from_frame(frame, **COLUMNS, reward="step-cost", success=["c"])
    kept = np.setdiff1d(np.arange(60), [19, 59])  # The last steps of b and a.
    assert np.array_equal(dataset._rows.observations, frame[["x", "v"]].to_numpy(np.float32)[kept])
    assert np.flatnonzero(dataset._rows.terminals).tolist() == [38]
    frame["won"] = np.arange(60) == 25  # In the middle of c.
    by_column = Dataset.from_frame(frame, **COLUMNS, reward="step-cost", success="won")
    assert all(np.array_equal(array, other) for array, other in zip(rows(dataset), rows(by_column)))


@pytest.mark.parametrize("message, x", [
    ("column 'x' has lists of several lengths, 1 to 3", [[1.0, 2.0], [1.0], [1.0, 2.0, 3.0], [1.0, 2.0]]),
    ("column 'x', row 2 is empty", [[1.0, 2.0], [1.0, 2.0], [1.0, None], [1.0, 2.0]]),
])
def test_lists_that_make_no_rows_are_refused(message, x):
    columns = pa.table({"x": x, "torque": [0.1] * 4, "run": [0, 0, 1, 1]})
    with pytest.raises(ValueError, match=message):
        Dataset.from_frame(columns, observations=["x"], actions=["torque"], reward="torque", episode="run")
