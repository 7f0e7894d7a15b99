"""Results of runs."""

from __future__ import annotations

import glob
import json
import os
import warnings
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

from quad_rl import _quad_rl


def runs(folders: str | PathLike[str] | Iterable[str | PathLike[str]] = "runs/*") -> list[dict[str, Any]]:
    """What runs have scored, as `pandas.DataFrame` takes it: a dictionary for each evaluation of each run.

    folders: a run folder, a pattern such as "runs/*", or several of them. Folders that hold no run are left out.

    Each dictionary has, from `learner report --json`: of its evaluation `step`, `episodes`, `complete`, `score` (mean over the
    episodes), `score_std`, `return` and `length`; of its run `run`, `dir`, `task`, `algorithm`, `variant`, `agent`, `seed`,
    `steps`, `normalized`, `scored_in`, `dataset_score`, `mean_last_3`, `mean_last_5` and `mean_last_50000_steps`, the same in
    all its rows; and each setting of its `config.toml` under its name there, like `experiment.batch_size`. A run that has
    no evaluation yet has one row, in which these are None.

    A learner may be writing the folders. A run that cannot be read is left out, with a warning that names it.
    """
    patterns = [folders] if isinstance(folders, (str, PathLike)) else folders
    found = [path for pattern in patterns for path in sorted(glob.glob(os.path.expanduser(os.fspath(pattern))))]
    rows: list[dict[str, Any]] = []
    for path in found:
        try:
            rows += rows_of(path) if Path(path, "config.toml").exists() else []
        except (OSError, RuntimeError) as error:
            warnings.warn(f"the run in {path} cannot be read: {error}", stacklevel=2)
    return rows


def metrics(folder: str | PathLike[str]) -> list[dict[str, float]]:
    """What a run has measured, as experiment trackers take it: a dictionary for each step at which there is something.

    folder: a run folder.

    Each dictionary has `step`. Where the run's metrics.jsonl has that step, it has `seconds` (of training) and, as `train/NAME`,
    each metric that was measured there. Where all episodes of an evaluation of that step are scored, it has
    `evaluation/score`, `evaluation/score_std` (if there are several episodes), `evaluation/return` and `evaluation/length`.
    Steps ascend.

    A learner may be writing the folder. Raises FileNotFoundError if it holds no metrics.jsonl, RuntimeError if a file is
    not what a learner writes.
    """
    lines = Path(folder, "metrics.jsonl").read_text().split("\n")[:-1]  # What follows the last end of a line is half a line.
    rows: dict[int, dict[str, float]] = {}
    for line in map(json.loads, lines):
        named = {name if name in ("step", "seconds") else f"train/{name}": value for name, value in line.items()}
        rows[line["step"]] = named
    for scored in rows_of(folder):
        if scored["complete"]:
            row = rows.setdefault(scored["step"], {"step": scored["step"]})
            values = {name: scored[name] for name in ("score", "score_std", "return", "length")}
            row |= {f"evaluation/{name}": value for name, value in values.items() if value is not None}
    return [rows[step] for step in sorted(rows)]


def rows_of(folder: str | PathLike[str]) -> list[dict[str, Any]]:
    """What `runs` gives for one run. Raises RuntimeError if a file is not what a learner writes."""
    run, config = map(json.loads, _quad_rl.read_run(folder))
    of_run = _flat("", {name: value for name, value in run.items() if name not in ("evaluations", "episodes_missing")})
    of_run |= _flat("", config)
    evaluations = [
        {
            **{name: one[name] for name in ("step", "episodes", "complete")},
            **{"score": one["score"]["mean"], "score_std": one["score"]["std"]},
            **{"return": one["mean_return"], "length": one["mean_length"]},
        }
        for one in run["evaluations"]
    ]
    none = dict.fromkeys(("step", "episodes", "complete", "score", "score_std", "return", "length"))
    return [of_run | evaluation for evaluation in evaluations or [none]]


def _flat(prefix: str, table: dict[str, Any]) -> dict[str, Any]:
    """Tables within tables as names with dots."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat |= _flat(f"{prefix}{name}.", value) if isinstance(value, dict) else {prefix + name: value}
    return flat
