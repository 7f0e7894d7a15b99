"""The metrics of a run in TensorBoard, Weights & Biases and MLflow."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import quad_rl

PAGE = (Path(__file__).parents[2] / "docs/python.md").read_text()


def series(run):
    """The values of a run's files by name and step."""
    metrics = {}
    for line in map(json.loads, (run / "metrics.jsonl").read_text().splitlines()):
        step = line.pop("step")
        del line["seconds"]
        for name, value in line.items():
            metrics.setdefault(f"train/{name}", {})[step] = value
    by_step = {}
    for line in map(json.loads, (run / "scores.jsonl").read_text().splitlines()):
        by_step.setdefault(line["step"], []).append(line)
    for step, lines in sorted(by_step.items()):
        for name in ("score", "return", "length"):
            metrics.setdefault(f"evaluation/{name}", {})[step] = np.mean([line[name] for line in lines])
        metrics.setdefault("evaluation/score_std", {})[step] = np.std([line["score"] for line in lines], ddof=1)
    return metrics


def same(metrics, expected):
    assert metrics.keys() == expected.keys()
    for name, values in expected.items():
        assert list(metrics[name]) == list(values), name
        np.testing.assert_allclose(list(metrics[name].values()), list(values.values()), rtol=1e-6, err_msg=name)


def run_example(tracker, run, folder, monkeypatch):
    """Runs the example of docs/python.md for a tracker, in a folder with the run in runs/mine."""
    shutil.copytree(run, folder / "runs/mine")
    monkeypatch.chdir(folder)
    [example] = re.findall(rf"^```python\n((?:import|from) {tracker}\b.*?)^```$", PAGE, re.M | re.S)
    exec(compile(example, "docs/python.md", "exec"), {"quad_rl": quad_rl})


def by_metric(rows):
    """The values of rows by name and step, without times."""
    metrics = {}
    for row in rows:
        for name, value in row.items():
            if "/" in name:
                metrics.setdefault(name, {})[row["step"]] = value
    return metrics


def test_tensorboard_has_each_value(hopper_runs, tmp_path, monkeypatch):
    run_example("tensorboardX", hopper_runs / "seed0", tmp_path, monkeypatch)
    events = EventAccumulator(str(tmp_path / "logs/mine"), size_guidance={"scalars": 0}).Reload()
    tags = [tag for tag in events.Tags()["scalars"] if "/" in tag]
    same({tag: {event.step: event.value for event in events.Scalars(tag)} for tag in tags}, series(hopper_runs / "seed0"))


def history(path):
    """The rows in a file of Weights & Biases: messages of Protocol Buffers in a log of LevelDB's format."""
    from wandb.proto.wandb_internal_pb2 import Record

    block, header = 32768, 7
    log, at, message = path.read_bytes(), header, b""
    while at + header <= len(log):
        if block - at % block < header:
            at += block - at % block
            continue
        start, length, kind = at + header, int.from_bytes(log[at + 4:at + 6], "little"), log[at + 6]
        message, at = message + log[start:start + length], start + length
        if kind in (1, 4):  # A whole message, or the last part of one.
            record, message = Record.FromString(message), b""
            if record.HasField("history"):
                yield {item.key or ".".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}


def test_weights_and_biases_has_each_value(hopper_runs, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    import wandb

    run_example("wandb", hopper_runs / "seed0", tmp_path, monkeypatch)
    wandb.teardown()  # The end of a run does not wait for its file.
    [file] = tmp_path.glob("wandb/offline-run-*/*.wandb")
    rows = list(history(file))
    assert [row["_step"] for row in rows] == [row["step"] for row in rows] == [10, 20]
    same(by_metric({**row, "step": row["_step"]} for row in rows), series(hopper_runs / "seed0"))


def test_mlflow_has_each_value(hopper_runs, tmp_path, monkeypatch):
    # Without this, MLflow wants a database, for which its small package has no code.
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", (tmp_path / "store").as_uri())
    import mlflow

    run_example("mlflow", hopper_runs / "seed0", tmp_path, monkeypatch)
    client, run = mlflow.MlflowClient(), mlflow.last_active_run()
    assert run.info.run_name == "mine"
    actual = {name: client.get_metric_history(run.info.run_id, name) for name in run.data.metrics if "/" in name}
    same({name: {one.step: one.value for one in values} for name, values in actual.items()}, series(hopper_runs / "seed0"))


def test_a_row_has_all_metrics_of_its_step(hopper_runs, tmp_path):
    shutil.copytree(hopper_runs / "seed0", tmp_path / "cut off")
    with (tmp_path / "cut off/metrics.jsonl").open("a") as file:
        file.write('{"step":30,"sec')
    rows = quad_rl.metrics(tmp_path / "cut off")
    assert [row["step"] for row in rows] == [10, 20]
    assert "train/target_q_mean" not in rows[0] and {"seconds", "train/target_q_mean", "evaluation/score_std"} <= rows[1].keys()
    same(by_metric(rows), series(hopper_runs / "seed0"))
    with pytest.raises(FileNotFoundError, match="nothing"):
        quad_rl.metrics(tmp_path / "nothing")
