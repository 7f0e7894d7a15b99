"""examples/probe.py: a run's critics beside true values."""

import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import quad_rl

FILE = Path(__file__).parents[2] / "examples/probe.py"
PROBE = runpy.run_path(str(FILE))


@pytest.mark.parametrize("tables, rows", [("gradients", [7, 3, 6]), ("choices", [4, 13])])
def test_it_prints_tables(hopper_runs, tables, rows):
    small = ["--states", "3", "--rollouts", "2", "--length", "3", "--json"]
    command = [sys.executable, FILE, tables, hopper_runs / "seed0", "20", *small]
    made = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=600).stdout)
    assert [len(table["rows"]) for table in made] == rows
    for table in made:
        for _, numbers in table["rows"]:
            assert len(numbers) == len(table["columns"]) and all(x["low"] <= x["high"] for x in numbers)


def test_networks_and_rollouts_are_the_policys(hopper_runs):
    run = PROBE["Run"](hopper_runs / "seed0", 20, length=2)
    observations = np.random.default_rng(0).normal(size=(2, 11))
    actions, values = run.policy.sample(observations, candidates=64, guidance=0, seed=5)
    inputs = np.concatenate([np.repeat(observations, 64, 0), actions.reshape(-1, 3)], 1)
    outputs, gradients = run.critics(inputs)
    assert np.allclose(outputs.mean(0)[:, 0], values.ravel(), atol=1e-4)
    changed = run.critics(inputs + 1e-5 * np.eye(14)[12])[0] - run.critics(inputs - 1e-5 * np.eye(14)[12])[0]
    assert np.allclose(changed[..., 0], 2e-5 * gradients[..., 12], atol=1e-9)
    assert np.isclose(PROBE["noisy_actions"](run, observations, 5)[2], np.abs(outputs).mean(), rtol=1e-4)

    hopper = run.simulation()
    hopper.reset(3)
    state, seen = hopper.state, hopper.observation
    episode = run.policy.begin(7, candidates=1)
    episode.act([seen])
    first = hopper.step(np.float32([0.3, -0.2, 0.1]))[0]
    second = hopper.step(episode.act([hopper.observation])[0])[0]
    expected = run.scale * (first + 0.99 * second)
    assert np.isclose(run.returns([(state, [0.3, -0.2, 0.1], 7)])[0], expected)


def test_a_simulation_refuses_other_sizes():
    hopper = quad_rl.Simulation("hopper")
    with pytest.raises(ValueError, match="action has 2 numbers, not 3"):
        hopper.step(np.zeros(2, np.float32))
    with pytest.raises(ValueError, match="qvel has 1 numbers, not 6"):
        hopper.state = [0.0] * 6, [0.0], None
    with pytest.raises(ValueError, match="unknown environment"):
        quad_rl.Simulation("humanoid")


def test_risks_are_those_of_the_known_errors():
    """At t the critics' mean slope l̄ is wrong by t/2, and each critic's by ±t more."""
    truth, t = np.array([0.5, -1.0, 2.0, 0.75] * 2), np.repeat([1, 2], 4)
    estimate, variance = truth + t / 2, t**2.0
    nu = estimate.var()
    lam = nu / (nu + 2 * variance)
    samples = SimpleNamespace(t=t, truth=truth, noise=0 * truth, estimate=estimate, variance=variance, denoised=truth, lam=lam)
    square = (estimate**2).mean()
    best = (estimate * truth).mean() / square
    expected = [((w * estimate - truth) ** 2).mean() / square for w in (0, 1, best, lam, lam, lam)]
    rows = PROBE["risks"](samples)
    assert np.allclose(rows[:, 1], [*expected, 0]) and np.allclose(rows[:, 2], [*expected, 0] - rows[5, 1])
    assert np.isclose(rows[1, 3], rows[2, 3])  # at the best scale
    agreement = PROBE["agreement"](samples)
    assert np.allclose(agreement[:2], [[lam[0], 1, 0, 1, 1], [lam[4], 1, 0, 1, 1]])


def test_choices_are_judged_by_the_truth():
    """One half of the rollouts says 0, 1, 2, …, the other the double, and so does the minimum; the mean takes 0, 10, 20, 30 first."""
    x = np.arange(32.0)[None]
    values = {"mean": np.where(x % 10 == 0, 100 - x, x), "min": -x, "mean-minus-std:1": x}
    for name, count, expected in [("mean", 10, [-6.75, 13.5, 1.25]), ("mean", 32, [-23.25, 46.5, 0]), ("mean-minus-std:1", 2, [0.75, 0, 2])]:
        assert np.allclose(PROBE["choose"](values[name], [x, 2 * x], x / 8, count), expected)
    assert np.isclose(PROBE["rank_correlation"]([1, 2, 3, 4, 5], [5, 6, 7, 8, 7]), 0.8207826816681234)  # SciPy's
    assert np.isclose(PROBE["rank_correlation"]([0, 0, 1, 2, 2], [3, 1, 1, -1, 0]), -0.892217816219194)
