"""Results of runs, and the package's type hints."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from conftest import train
from quad_rl import Run, runs


def test_runs_are_a_table(hopper_runs, data, tmp_path):
    table = pd.DataFrame(runs(f"{hopper_runs}/*"))
    assert table[["seed", "step", "episodes"]].values.tolist() == [[0, 10, 3], [0, 20, 3], [1, 10, 3], [1, 20, 3]]
    assert table.complete.all() and (table["experiment.batch_size"] == 256).all() and (table.task == "hopper-demo").all()
    for run, rows in table.groupby("dir"):
        lines = [json.loads(line) for line in Path(run, "scores.jsonl").read_text().splitlines()]
        for row in rows.itertuples():
            scores = [line["score"] for line in lines if line["step"] == row.step]
            np.testing.assert_allclose([row.score, row.score_std], [np.mean(scores), np.std(scores, ddof=1)])
    assert table.groupby("step").score.mean().notna().all()

    (tmp_path / "of[0]" / "no run").mkdir(parents=True)
    train(tmp_path / "of[0]" / "unscored", data, "--task", "own-data", "--steps", "1")
    unscored = runs([tmp_path / "of*" / "*", hopper_runs / "seed1"])
    assert [(row["run"], row["step"]) for row in unscored] == [("unscored", None), ("seed1", 10), ("seed1", 20)]
    assert runs(tmp_path / "of[0]" / "unscored") == unscored[:1], "a folder is no pattern"
    assert set(unscored[0]) >= {"score", "score_std", "return", "length", "complete", "mean_last_3", "agent"}
    assert runs(tmp_path / "nothing*") == []


def test_a_damaged_run_is_skipped_with_a_warning(data, tmp_path):
    for name in ("damaged", "whole"):
        train(tmp_path / name, data, "--task", "own-data", "--steps", "1")
    (tmp_path / "damaged" / "scores.jsonl").write_text('{"step": 10}\n')
    with pytest.warns(UserWarning, match="damaged cannot be read: .*scores.jsonl, line 1, is not what a learner writes"):
        actual = runs(tmp_path / "*")
    assert [row["run"] for row in actual] == ["whole"]
    (tmp_path / "odd" / "config.toml").mkdir(parents=True)
    with pytest.warns(UserWarning, match="odd cannot be read"):
        assert runs(tmp_path / "odd") == []
    with pytest.raises(RuntimeError, match="scores.jsonl, line 1"):
        Run(tmp_path / "damaged").scores


SAMPLE = """
import numpy as np
import quad_rl
from numpy.typing import NDArray

policy: quad_rl.Policy = quad_rl.Policy.load("x", precision="bf16")
action: NDArray[np.float32] = policy.act([0.0], candidates=3, seed=np.arange(1))
action = policy.act(np.zeros(3), rule="best", aggregate="min", seed=None)
drawn, values = policy.sample(action, candidates=2, seed=[1])
number = float(policy.value(action, drawn[0]))
episodes: quad_rl.Episodes = policy.begin(range(3))
action = episodes.act(action, rows=[1])
size: int = policy.observation_size + policy.step + len(episodes)
dataset = quad_rl.Dataset.from_episodes([{"rewards": [1.0]}])
dataset = quad_rl.Dataset.from_lerobot("x", observations=["observation.state"], reward=lambda episode: episode["r"], success=[1])
dataset = quad_rl.Dataset.from_frame({"x": [1.0]}, observations=["x"], actions=["x"], reward="x", episode="x")
dataset.save("y")
problems = dataset.inspect()["problems"]
rows: list[dict[str, object]] = [dict(row) for row in quad_rl.runs("z")]
value: float = quad_rl.metrics("z")[0]["train/target_q_mean"]
run: quad_rl.Run = quad_rl.train(dataset, run_dir="r", steps=5, normalize="observations", fresh=True, set={"batch_size": 64})
policy, address, score = run.policy(step=5), run.page.upper(), run.scores[-1]["score"] + run.metrics[0]["step"]
"""
WRONG = """
import quad_rl
quad_rl.Policy.load(3)
quad_rl.Policy.load("x").act([0.0], 3)
quad_rl.Dataset.from_arrays(observations=[])
quad_rl.runs(5)
quad_rl.metrics(["z"])
quad_rl.train("x")
quad_rl.Dataset.from_lerobot("x", observations=3)
"""


def test_the_type_checker_accepts_valid_calls_only(tmp_path):
    def errors(sample):
        (tmp_path / "sample.py").write_text(sample)
        command = [sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path / "cache"), "sample.py"]
        checked = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert checked.returncode in (0, 1), checked.stderr
        return [line for line in checked.stdout.splitlines() if ": error: " in line]

    assert errors(SAMPLE) == []
    assert {line.split(":")[1] for line in errors(WRONG)} == {"3", "4", "5", "6", "7", "8", "9"}


def test_everything_public_is_typed(tmp_path):
    import quad_rl

    for name in ("Policy", "Episodes", "Dataset", "Run"):
        for member in dir(getattr(quad_rl, name)):
            documented = member.startswith("_") or getattr(getattr(quad_rl, name), member).__doc__
            assert documented, f"{name}.{member}"
    assert quad_rl.runs.__doc__ and quad_rl.metrics.__doc__ and quad_rl.train.__doc__
    checked = subprocess.run([sys.executable, "-m", "mypy", "--strict", "--cache-dir", str(tmp_path), "-p", "quad_rl"],
                             capture_output=True, text=True, timeout=600)
    assert checked.returncode == 0, checked.stdout
