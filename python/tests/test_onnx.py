"""ONNX models act as their policies do, for every algorithm and every way to choose."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from conftest import OBSERVATION, arrays, train

import quad_rl
from quad_rl import Policy, export_onnx
from quad_rl.onnx.choosing import choose
from quad_rl.onnx.graph import Graph
from quad_rl.onnx.mlp import activate, slope

PRESETS = Path(__file__).parents[2] / "presets"
ALGORITHMS = sorted(preset.stem for preset in PRESETS.glob("*.toml") if preset.stem != "tasks")
OWN = ["--task", "own-data", "--env", "my-robot", "--steps", "2", "--set", "batch_size=8"]
RULES = ["best", "nearest", "softmax:0.1", "average:0.1:4", "average:0.01:20"]


def batches():
    """Batches of one, three and five random observations, and extreme ones."""
    states = np.random.default_rng(8).normal(3.0, 2.0, (17, OBSERVATION)).astype(np.float32)
    states[9:13] *= np.array([[1e2], [1e3], [-1e4], [0.0]], np.float32)
    return [states[:1], states[1:4], states[4:9], states[9:10], states[9:13], states[13:]]


def largest(array):
    return np.abs(array).reshape(len(array), -1).max(1)


def close(actual, expected, by):
    """Largest error, relative to a row's largest number if that is above 1."""
    assert actual.shape == expected.shape
    away = largest(actual - expected) / np.maximum(1.0, largest(expected))
    assert (away <= by).all(), away


def compare(policy, path, **choice):
    """Compares the model of this choice with the policy."""
    export_onnx(policy, path, **choice)
    onnx.checker.check_model(path, full_check=True)
    # In float32, norms of nearly equal numbers leave some plans 1.1e-5 from float64 natively, and 4e-6 in the model.
    by = 5e-5 if policy.kind == "planner" else 1e-5
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    for seed, states in enumerate(batches()):
        chunk = policy.about["chunk"]
        seen = [states * (i + 1) / chunk["history"] for i in range(chunk["history"])]
        inputs = {"observations": states if len(seen) == 1 else np.stack(seen, axis=1), **policy.noise(len(states), seed=seed, **choice)}
        assert {given.name for given in session.get_inputs()} == set(inputs)
        actual = dict(zip((out.name for out in session.get_outputs()), session.run(None, inputs)))
        if "values" in actual:
            asked = {name: choice[name] for name in ("candidates", "aggregate", "guidance") if name in choice}
            close(actual["values"], policy.sample(states, seed=seed, **asked)[1], by)
        episodes = policy.begin(range(seed, seed + len(states)), **choice)
        for before in seen[:-1]:
            episodes.observe(before)
        if chunk["length"] > 1:
            assert actual["actions"].shape == (len(states), chunk["length"], policy.action_size)
            assert session.get_modelmeta().custom_metadata_map == {"chunk": str(chunk["length"]), "replan": str(chunk["replan"])}
            for i in range(chunk["replan"]):
                close(actual["actions"][:, i], episodes.act(states * (i + 1)), by)
            continue
        close(actual["actions"], episodes.act(states), by)
        for later in range(1, actual.get("plan", states[:, None]).shape[1]):
            close(actual["plan"][:, later], episodes.act(states), by)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_models_of_each_algorithm_act_like_the_policy(algorithm, data, tmp_path):
    compare(Policy.load(train(tmp_path / "run", data, *OWN, "--algorithm", algorithm, layers=False)), tmp_path / "policy.onnx")


SMALLER = "actor={hidden=[24], activation=\"gelu\", norm=true}"


@pytest.mark.parametrize("flags, choice", [
    (["qc", "--agent", "replan=2", "--normalize", "actions,observations", "--agent", SMALLER], {"rule": "softmax:0.1"}),
    (["quad", "--agent", "chunk=3", "--normalize", "actions"], {"candidates": 4, "guidance": 3.0}),
    (["quad", "--agent", "chunk=3", "--agent", "guidance=none"], {"candidates": 1}),
    (["fql", "--agent", "chunk=4", "--agent", "replan=3"], {}),
    (["idql", "--agent", "chunk=2"], {"rule": "average:0.1:4"}),
    (["diffusion-policy", "--agent", "replan=16", "--normalize", "actions"], {}),
])
def test_models_of_chunks(flags, choice, data, tmp_path):
    algorithm, *given = flags
    run = train(tmp_path / "run", data, *OWN, "--algorithm", algorithm, *given, layers=False)
    compare(Policy.load(run), tmp_path / "policy.onnx", **choice)


def test_a_policy_of_chunks_executes_them(data, tmp_path):
    policy = Policy.load(train(tmp_path / "run", data, *OWN, "--algorithm", "qc", layers=False))
    (states, *_), episodes = batches(), policy.begin([0])
    executed = [episodes.act(states * step) for step in (1, 2)]
    np.testing.assert_array_equal(executed[0], policy.act(states, seed=0))
    # The second action is the first chunk's, whatever is seen by then.
    again = policy.begin([0])
    np.testing.assert_array_equal([again.act(states) for _ in range(2)], executed)


@pytest.mark.parametrize("name", ["norm", "scaled", "dql", "dtql"])
def test_networks_units_and_processes_of_all_kinds(snapshots, name, tmp_path):
    compare(Policy.load(snapshots[name]), tmp_path / "policy.onnx")


@pytest.mark.parametrize("rule", RULES)
def test_every_choice(snapshots, rule, tmp_path):
    policy = Policy.load(snapshots["align-iql"])
    for candidates, aggregate in [(1, "mean"), (6, "min"), (30, "mean-minus-std:0.5")]:
        compare(policy, tmp_path / "policy.onnx", candidates=candidates, rule=rule, aggregate=aggregate)


@pytest.mark.parametrize("name", ["quad", "norm", "align-iql", "dql"])
def test_models_are_guided_like_the_policy(snapshots, name, tmp_path):
    compare(Policy.load(snapshots[name]), tmp_path / "policy.onnx", candidates=4, guidance=3.0)


@pytest.mark.parametrize("name", ["mish", "relu", "silu", "tanh", "gelu"])
def test_slopes_of_activations(name):
    graph, x = Graph(), np.linspace(-9, 9, 400, dtype=np.float32)[:, None]
    given = graph.input("x", (1,))
    outputs = {"y": (activate(name, given), (1,)), "slope": (slope(name, given), (1,))}
    session = onnxruntime.InferenceSession(graph.model(outputs, "").SerializeToString(), providers=["CPUExecutionProvider"])
    above, below = (session.run(["y"], {"x": x + step})[0] for step in (1e-2, -1e-2))
    np.testing.assert_allclose(session.run(["slope"], {"x": x})[0], (above - below) / 2e-2, atol=3e-4)


BELOW_ONE = np.nextafter(np.float32(1), np.float32(0))
EDGES = [0.0, float(BELOW_ONE), 1.0]


def sample_by_rule(scores, temperature, uniform):
    """The native policy's rule, with its own float64; the best if rounding leaves none."""
    weights = np.exp((scores - scores.max()).astype(np.float64) / np.float64(np.float32(temperature)))
    sums = np.cumsum(weights)
    beyond = sums > np.float64(np.float32(uniform)) * sums[-1]
    return int(np.argmax(beyond)) if beyond.any() else int(np.argmax(scores))


def chosen(scores, rule, uniform):
    """The share of each candidate in the model's choice, by one-hot candidates."""
    graph, (n, count) = Graph(), scores.shape
    inputs = {"drawn": np.tile(np.eye(count, dtype=np.float32), (n, 1, 1)), "scores": scores, "uniform": uniform}
    drawn, of, numbers = (graph.input(name, array.shape[1:]) for name, array in inputs.items())
    model = graph.model({"taken": (choose(drawn, of, rule, count, numbers), (count,))}, "")
    return onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"]).run(None, inputs)[0]


@pytest.mark.parametrize("edge", [*EDGES, 0.5])
def test_every_uniform_number_selects_the_policy_s_candidate(edge):
    rng = np.random.default_rng(0)
    scores = rng.normal(size=(2000, 10)).astype(np.float32)
    scores[:500, 0] -= 60  # A float32 sum of the others does not see it.
    scores[500:600, 0] = scores[500:600].max(1) - 200  # Below float32's exp, not below float64's.
    scores[600:700] = 1.5
    for temperature in (1.0, 0.05):
        taken = chosen(scores, f"softmax:{temperature}", np.full((2000, 1), edge, np.float32))
        assert np.array_equal(taken.argmax(1), [sample_by_rule(row, temperature, edge) for row in scores])
    if edge == BELOW_ONE:
        assert (chosen(scores[:500], "softmax:1", np.full((500, 1), edge, np.float32)).argmax(1) > 0).all()
    if edge == 1.0:
        assert np.array_equal(taken.argmax(1), scores.argmax(1))
    mean = chosen(scores, "average:1:4", np.full((2000, 4), edge, np.float32))
    np.testing.assert_allclose(mean.sum(1), 1, rtol=1e-6)
    assert ((mean > 0).sum(1) == 4).all(), "four are taken, each once"


@pytest.mark.parametrize("name", ["dql", "dtql", "align-iql"])
def test_extreme_uniform_numbers_choose_like_the_policy(snapshots, name, tmp_path):
    """At 0 the first candidate, at 1 the best, just below 1 the last with any weight."""
    policy, states = Policy.load(snapshots[name]), batches()[2]
    export_onnx(policy, tmp_path / "policy.onnx", rule="softmax:0.1")
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    drawn, values = policy.sample(states, seed=3)
    best = policy.act(states, rule="best", seed=3)
    for edge in EDGES:
        noise = policy.noise(len(states), rule="softmax:0.1", seed=3)
        noise["uniform"][:] = edge
        actual = session.run(["actions"], {"observations": states, **noise})[0]
        place = [sample_by_rule(row, 0.1, edge) for row in values]
        expected = best if edge == 1.0 else drawn[np.arange(len(states)), place]
        assert edge or place == [0] * len(states)
        close(actual, expected, 1e-5)


@pytest.mark.parametrize("flags", [
    ["replan_every=1", "guidance={steps=2, scale=3.0, stop=0}", "network={horizon=6, channels=8, multipliers=[1, 4], groups=2, "
     "attention={heads=2, width=3}}"],
    ["diffusion_steps=1", "replan_every=2", "network={horizon=5, channels=4, multipliers=[4], groups=2}"],
    ["diffusion_steps=3", "guidance={steps=1, scale=1.0, stop=9}"],
])
def test_planners(data, flags, tmp_path):
    given = [part for flag in flags for part in ("--agent", flag)]
    run = train(tmp_path / "run", data, *OWN, "--algorithm", "diffuser", "--normalize", "observations,actions", *given, layers=False)
    compare(Policy.load(run), tmp_path / "policy.onnx")


@pytest.mark.parametrize("algorithm", ["iql", "quad", "diffuser"])
def test_constant_actions_are_exact_and_constant_observations_ignored(algorithm, tmp_path):
    given = arrays()
    given["observations"][:, 4], given["actions"][:, 1] = 90.0, 0.1
    quad_rl.Dataset.from_arrays(**given).save(tmp_path / "data.hdf5")
    units = ["--normalize", "observations,actions,rewards"]
    policy = Policy.load(train(tmp_path / "run", tmp_path / "data.hdf5", *OWN, "--algorithm", algorithm, *units, layers=False))
    compare(policy, tmp_path / "policy.onnx")
    session, states = onnxruntime.InferenceSession(tmp_path / "policy.onnx"), batches()[2]
    drawn = policy.noise(len(states), seed=1)
    for other in (90.0, 0.0):
        states[:, 4] = other
        actions = session.run(["actions"], {"observations": states, **drawn})[0]
        assert (actions[:, 1] == np.float32(0.1)).all() and (policy.act(states, seed=1)[:, 1] == np.float32(0.1)).all()
        first = actions if other else first
        assert np.array_equal(actions, first)
    assert policy.about["scaling"]["rewards"] > 0


def test_the_example_of_the_documentation_runs(snapshots, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = PRESETS.parent
    page, program = (root / "docs/deploying.md").read_text(), (root / "examples/act.cpp").read_text()
    exec(page.split("```python\n")[1].split("```")[0], {"quad_rl": quad_rl, "policy": Policy.load(snapshots["quad"])})
    inputs = onnxruntime.InferenceSession("policy.onnx").get_inputs()
    assert [given.shape[1:] for given in inputs] == [[OBSERVATION], [5, 10, 3]] and "{1, 11}, drawn[] = {1, 5, 10, 3}" in program


def test_refuses_invalid_choices(snapshots, tmp_path):
    for message, choice in {"takes a value function": {"rule": "nearest"}, "candidates is 0": {"candidates": 0},
                            'aggregate is "max"': {"aggregate": "max"}}.items():
        with pytest.raises(ValueError, match=message):
            export_onnx(snapshots["quad"], tmp_path / "policy.onnx", **choice)
    assert not (tmp_path / "policy.onnx").exists()
    without = "import sys; sys.modules['onnx'] = None; import quad_rl; quad_rl.export_onnx(sys.argv[1], 'policy.onnx')"
    ended = subprocess.run([sys.executable, "-c", without, snapshots["quad"]], capture_output=True, text=True, timeout=60)
    assert "hint: pip install" in ended.stderr and "ImportError" in ended.stderr


FULL = """
import resource, sys
from quad_rl import Policy, export_onnx

policy = Policy.load(sys.argv[1])
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))  # As a full disk: a write of more fails.
export_onnx(policy, sys.argv[2])
"""


def test_a_full_disk_leaves_the_previous_model(snapshots, tmp_path):
    export_onnx(snapshots["dql"], tmp_path / "policy.onnx")
    before = (tmp_path / "policy.onnx").read_bytes()
    command = [sys.executable, "-c", FULL, snapshots["quad"], tmp_path / "policy.onnx"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1 and "OSError" in ended.stderr, ended.stderr
    assert (tmp_path / "policy.onnx").read_bytes() == before and [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]
