"""Runs the examples of the documentation; test_trackers.py those of trackers, test_cube.py the cube."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

from conftest import free_endpoint

DOCS = Path(__file__).parents[2] / "docs"


def test_the_examples_run(hopper_runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(hopper_runs / "seed0", "runs/mine")
    page, names = (DOCS / "python.md").read_text(), {}
    blocks = re.findall(r"^```(python|sh)\n(.*?)^```$", page, re.M | re.S)
    ran = 0
    for kind, block in blocks:
        if kind == "python" and not re.search(r"evaluate\(|Evaluators\(|import (wandb|mlflow)", block):
            exec(compile(block.replace("steps=20_000", "steps=2"), "docs/python.md", "exec"), names)
            ran += 1
    assert ran >= 5 and len(names["table"]) >= 2 and set(names["table"].dir) == {"runs/mine", "runs/my-robot"}


def test_the_cart_learns_online(tmp_path):
    endpoint = free_endpoint()
    example = (DOCS / "../examples/online.py").read_text()
    for usual, here in [
        ("workers=2", f'workers=1, connect="{endpoint}"'),
        ("run_dir", f'listen="{endpoint}", run_dir'),
        ("record(100)", "record(20)"),
        ("2_000", "10"),
        ("5_000", "120"),
        ("1_000", "70"),
    ]:
        assert example.count(usual) == 1
        example = example.replace(usual, here)
    (tmp_path / "online.py").write_text(example)
    command = [sys.executable, "online.py", "run"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    scores = json.loads(ended.stdout.replace("(", "[").replace(")", "]"))
    assert [score[:2] for score in scores] == [[70, 60], [130, 120]]
