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
    """The scores of runs, for `pandas.DataFrame`: a dictionary for each evaluation of each run.

    folders: a run folder, a pattern such as "runs/*", or several of them. Folders without a run are left out.

    Each dictionary has, from `learner report --json`, the evaluation's `step`, `environment_steps` (online, else None),
    `episodes`, `complete`, `score` (mean over the episodes), `score_std`, `return` and `length`; the run's `run`, `dir`,
    `task`, `algorithm`, `variant`, `agent`, `seed`, `steps`, `normalized`, `scored_in`, `dataset_score`, `mean_last_3`,
    `mean_last_5` and `mean_last_50000_steps`, the same in all its rows; and each setting of its `config.toml`, like
    `experiment.batch_size`. A run without an evaluation has one row, in which the evaluation's values are None.

    A learner may be writing the folders. A run that cannot be read is left out, with a warning that names it.
    """
    patterns = [folders] if isinstance(folders, (str, PathLike)) else folders
    expanded = [os.path.expanduser(os.fspath(pattern)) for pattern in patterns]
    paths = [path for given in expanded for path in ([given] if os.path.exists(given) else sorted(glob.glob(given)))]
    rows: list[dict[str, Any]] = []
    for path in paths:
        try:
            rows += run_rows(path) if Path(path, "config.toml").exists() else []
        except (OSError, RuntimeError) as error:
            warnings.warn(f"the run in {path} cannot be read: {error}", stacklevel=2)
    return rows


def metrics(folder: str | PathLike[str]) -> list[dict[str, float]]:
    """The metrics of a run, for experiment trackers: a dictionary for each step with any.

    folder: a run folder.

    Each dictionary has `step`. For a step in the run's metrics.jsonl, it has `seconds` (of training) and each metric as
    `train/NAME`. For a step whose evaluation is complete, it has `evaluation/score`, `evaluation/score_std` (if there are several
    episodes), `evaluation/return` and `evaluation/length`. Steps ascend.

    A learner may be writing the folder. Raises FileNotFoundError if it holds no metrics.jsonl, RuntimeError if a file
    is invalid.
    """
    lines = Path(folder, "metrics.jsonl").read_text().split("\n")[:-1]  # The last line may be incomplete.
    rows: dict[int, dict[str, float]] = {}
    for line in map(json.loads, lines):
        named = {name if name in ("step", "seconds") else f"train/{name}": value for name, value in line.items()}
        rows[line["step"]] = named
    for scored in run_rows(folder):
        if scored["complete"]:
            row = rows.setdefault(scored["step"], {"step": scored["step"]})
            values = {name: scored[name] for name in ("score", "score_std", "return", "length")}
            row |= {f"evaluation/{name}": value for name, value in values.items() if value is not None}
    return [rows[step] for step in sorted(rows)]


def run_rows(folder: str | PathLike[str]) -> list[dict[str, Any]]:
    """The rows of `runs` for one run. Raises RuntimeError if a file is invalid."""
    run, config = map(json.loads, _quad_rl.read_run(folder))
    common = _flat("", {name: value for name, value in run.items() if name not in ("evaluations", "episodes_missing")})
    common |= _flat("", config)
    evaluations = [
        {
            **{name: one[name] for name in ("step", "episodes", "complete")},
            "environment_steps": one.get("environment_steps"),
            **{"score": one["score"]["mean"], "score_std": one["score"]["std"]},
            **{"return": one["mean_return"], "length": one["mean_length"]},
        }
        for one in run["evaluations"]
    ]
    none = dict.fromkeys(("step", "episodes", "complete", "environment_steps", "score", "score_std", "return", "length"))
    return [common | evaluation for evaluation in evaluations or [none]]


def _flat(prefix: str, table: dict[str, Any]) -> dict[str, Any]:
    """Flattens nested tables to dotted names."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat |= _flat(f"{prefix}{name}.", value) if isinstance(value, dict) else {prefix + name: value}
    return flat
