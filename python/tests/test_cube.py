"""OGBench's cube of docs/python.md: recorded by examples/cube_single.py, trained, evaluated in its environment."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import quad_rl
from conftest import free_endpoint

ROOT = Path(__file__).parents[2]
# Changes that make the page's example quick.
QUICK = {
    'agent={"expectile": 0.9}': 'agent={"actor.hidden": [8], "critic.hidden": [8], "value.hidden": [8]}, set={"batch_size": 16}',
    "steps=30_000, eval_interval=6_000": "steps=20, eval_interval=20",
    "episodes=20": "episodes=2, listen=there",
    'score="success"': 'score="success", connect=there, workers=1',
}


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_cube_from_recording_to_scores(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    monkeypatch.chdir(tmp_path)
    subprocess.run([sys.executable, ROOT / "examples/cube_single.py", "ogbench", "2"], check=True, timeout=600)
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs/python.md").read_text(), re.M | re.S)
    (block,) = [block for block in blocks if "from_ogbench(" in block]
    for there, here in QUICK.items():
        assert there in block
        block = block.replace(there, here)
    there = free_endpoint()
    names = {"quad_rl": quad_rl, "cube": "cube-single-singletask-v0", "there": there}
    exec(compile(block, "docs/python.md", "exec"), names)
    assert [(row["step"], row["episodes"], row["length"]) for row in names["run"].scores] == [(20, 2, 200.0)]

    rows = names["dataset"]._rows
    assert rows.observations.shape == (2000, 28) and rows.actions.shape == (2000, 5)
    assert np.flatnonzero(rows.timeouts | rows.terminals)[[0, -1]].tolist() == [999, 1999]
    assert np.array_equal(rows.observations[1:999], rows.next_observations[:998])
    assert {*np.unique(rows.rewards).tolist()} <= {-1.0, 0.0}
    with np.load("ogbench/cube-single-play-v0.npz") as arrays:
        assert np.ptp(arrays["qpos"][:1001, 14:16], axis=0).min() > 0.05  # The arm carries the cube about.
