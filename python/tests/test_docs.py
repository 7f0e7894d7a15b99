"""What the pages show runs as it stands there; test_trackers.py runs what is about other trackers."""

import re
import shutil
import subprocess
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def test_the_page_s_examples_run(hopper_runs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(hopper_runs / "seed0", "runs/mine")
    page, names = (DOCS / "python.md").read_text(), {}
    blocks = re.findall(r"^```(python|sh)\n(.*?)^```$", page, re.M | re.S)
    ran = 0
    for kind, block in blocks:
        if kind == "python" and not re.search(r"evaluate\(|import (wandb|mlflow)", block):
            exec(compile(block, "docs/python.md", "exec"), names)
            ran += 1
        elif "--run-dir runs/my-robot" in block:
            subprocess.run([*block.split(), "--steps", "2"], check=True, capture_output=True, timeout=60)
    assert ran >= 4 and len(names["table"]) >= 2 and set(names["table"].dir) == {"runs/mine", "runs/my-robot"}
