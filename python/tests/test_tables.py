"""Tables of any kind, quad-convert, and the names that go from a table into the policy."""

import json
import re
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
    frame.to_parquet(tmp_path / "log.parquet", row_group_size=7)
    lists = pa.Table.from_pandas(frame).append_column("both", pa.array(list(frame[["x", "v"]].to_numpy())))
    for source, changed in [(frame, {}), (tmp_path / "log.csv", {}), (str(tmp_path / "log.tsv"), {}), (tmp_path / "log.parquet", {}),
                            ({name: column.to_numpy() for name, column in frame.items()}, {}), (lists, {"observations": ["both"]}),
                            (lists.to_pandas(), {"observations": ["both"]}),
                            (frame.sort_values(["fell", "run"], kind="stable").sort_index(level=0), {})]:
        dataset = Dataset.from_frame(source, **{**COLUMNS, **changed}, reward="gain", terminal="fell")
        assert all(np.array_equal(array, other) for array, other in zip(rows(dataset), right))
        assert dataset.observation_names == (["both[0]", "both[1]"] if changed else ["x", "v"])
    mixed = frame.iloc[np.argsort(np.arange(60) % 20, kind="stable")]  # Three runs, recorded at once.
    dataset = Dataset.from_frame(mixed, **COLUMNS, reward="gain", terminal="fell")
    assert all(np.array_equal(array, other) for array, other in zip(rows(dataset), right))
    assert dataset.notes[0].startswith("3 of 3 episodes: their rows do not lie together")


def test_what_a_table_lacks_is_asked_for(tmp_path):
    frame, rule = table(), {**COLUMNS, "reward": "step-cost"}
    by_name = Dataset.from_frame(frame, **rule, success=["a"])
    assert by_name._rows.terminals.sum() == 1 and by_name._rows.rewards[38] == 0 and by_name._rows.rewards.sum() == -57
    assert "no episode terminates" in Dataset.from_frame(frame, **{**rule, "reward": "gain"}).notes[0]
    holes = frame.assign(x=frame["x"].where(np.arange(60) != 33))
    holes.to_parquet(tmp_path / "holes.parquet")
    for message, source, asked in [
        ("column 'x', row 33 is empty", tmp_path / "holes.parquet", {**rule, "success": "all"}),
        ("episode a: observations, row 13: number 0 is nan", holes, {**rule, "success": "all"}),
        ("there is no column 'run' for episodes\nhint: there are 'x', 'v'", frame.drop(columns="run"), rule),
        ("no column 'y'\nhint: there are 'x', 'v', 'torque', 'gain', 'run', 'fell'", frame, {**rule, "observations": ["y"], "success": "all"}),
        ("column 'run' holds", frame, {**rule, "observations": ["run"], "success": "all"}),
        ("\nhint: success= a column", frame, rule),
        ('hint: terminal="success", or rewards', frame, {**rule, "success": "all", "terminal": "never"}),
        ("there is no episode", frame[:0], {**rule, "success": "all"}),
    ]:
        with pytest.raises(ValueError, match=message):
            Dataset.from_frame(source, **asked)


def test_names_go_into_the_file_and_the_policy(tmp_path):
    frame = table(steps=60)
    Dataset.from_frame(frame, **COLUMNS, reward="gain", terminal="fell").save(tmp_path / "log.hdf5")
    with h5py.File(tmp_path / "log.hdf5") as file:
        assert list(file.attrs["observation_names"]) == ["x", "v"] and list(file.attrs["action_names"]) == ["torque"]
    inspected = subprocess.run(["learner", "datasets", "inspect", "--json", tmp_path / "log.hdf5"], capture_output=True)
    assert json.loads(inspected.stdout)["observation_names"] == ["x", "v"]
    snapshot = train(tmp_path / "run", tmp_path / "log.hdf5", "--task", "own-data", "--env", "mine", "--steps", "2", "--scale",
                     "actions,states")
    policy = Policy.load(snapshot)
    assert (policy.observation_names, policy.action_names) == (["x", "v"], ["torque"])
    seen = frame[["x", "v"]]
    assert np.array_equal(policy.act(seen, seed=1), policy.act(seen.to_numpy(), seed=1))
    for act in (policy.act, policy.begin(list(range(180))).act, policy.sample):
        with pytest.raises(ValueError, match="has the columns v, x, but the policy takes, in this order, x, v"):
            act(frame[["v", "x"]])
    with pytest.raises(ValueError, match=r"actions has the columns gain, but the policy takes, in this order, torque"):
        policy.value(seen, frame[["gain"]])
    with pytest.raises(ValueError, match=r"has shape \[180, 3\], but must have \[n, 2\] or \[2\]: x, v"):
        policy.act(np.zeros((180, 3)))


def test_quad_convert_reads_what_python_reads(tmp_path, capsys):
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
    with h5py.File(tmp_path / "demo.hdf5", "w") as file:
        for name, width in {"actions": 2, "obs/object": 3, "next_obs/object": 3}.items():
            file[f"data/demo_0/{name}"] = np.random.default_rng(0).uniform(-1, 1, (9, width))
        file["data/demo_0/rewards"] = file["data/demo_0/dones"] = np.arange(9) == 8
    assert convert(tmp_path / "demo.hdf5", "--observations", "object")[0] == 0
    (tmp_path / "none-huge-v0.npz").touch()
    for message, words in {
        "needs --actions and --reward": [tmp_path / "log.csv", "--observations", "x", "--episode", "run"],
        "--task says nothing of this source": [*log, "--reward", "gain", "--task", "pick"],
        "nothing says what is rewarded": [folder, "--observations", "observation.state"],
        "there is no nothing.csv": ["nothing.csv"],
        "has no rewards": ["ogbench:cube-double-play-v0"],
        "hint: put it and antmaze-huge-navigate-v0-val.npz there": ["ogbench:antmaze-huge-navigate-singletask-v0", "--folder", tmp_path],
        "cannot be read: NameNotFound: ": ["ogbench:none-huge-singletask-v0", "--folder", tmp_path],
    }.items():
        status, said = convert(*words)
        assert status == 1 and said.startswith("quad-convert: ") and message in said, said


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
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, cwd=tmp_path).stderr
    assert "ImportError: " in said and "hint: pip install " in said and f"which the extra '{extra}' of quad-rl names" in said, said


def test_extras_are_what_the_hints_say():
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    of_project = {extra: [re.split("[>=]", package)[0] for package in packages]
                  for extra, packages in project["optional-dependencies"].items()}
    assert of_project == EXTRAS
