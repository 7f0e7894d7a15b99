"""Runs the examples of the documentation; test_trackers.py those of trackers, test_cube.py the cube."""

import re
import shutil
from pathlib import Path

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
