"""Policies compared with a NumPy implementation and with the evaluator; refusals."""

import copy
import json
import pickle
import subprocess
import sys
import threading
import time
import warnings
from importlib.metadata import version
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import ACTION, OBSERVATION, POLICIES
from reference import Random, Reference

from quad_rl import Policy

POLICY_STREAM, RESET_STREAM = 2, 1
HOPPER = Path(__file__).parents[2] / "evaluator" / "assets" / "hopper.xml"


def observations(n, seed=5):
    return np.random.default_rng(seed).normal(3.0, 2.0, (n, OBSERVATION)).astype(np.float32)


def close(actual, expected):
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", POLICIES)
def test_acts_like_the_numpy_implementation(snapshots, name):
    policy, reference = Policy.load(snapshots[name]), Reference(snapshots[name])
    states = observations(6)
    expected = [reference.act(state.astype(np.float64), Random(40 + i, POLICY_STREAM)) for i, state in enumerate(states)]
    close(policy.act(states, seed=40), [action for action, _, _ in expected])
    if policy.kind == "gaussian":
        assert policy.choice is None
        return
    drawn, values = policy.sample(states, seed=40)
    close(drawn, [candidates for _, candidates, _ in expected])
    close(values, [values for _, _, values in expected])
    assert policy.choice["candidates"] == drawn.shape[1] > 1
    close(policy.value(states, drawn[:, 3]), values[:, 3])
    critics = [reference.values(reference.to_network("observations", states), reference.to_network("actions", drawn[:, 3]), how)
               for how in ("min", "mean")]
    close([policy.value(states, drawn[:, 3], aggregate=how) for how in ("min", "mean")], critics)


def test_a_call_may_change_the_choice(snapshots):
    policy, reference = Policy.load(snapshots["align-iql"]), Reference(snapshots["align-iql"])
    state = observations(1)[0]
    for rule, file_rule in [("best", "best"), ("nearest", "nearest"), ("softmax:0.05", {"softmax": {"temperature": 0.05}})]:
        for aggregate in ("min", "mean", "mean-minus-std:0.5"):
            expected, _, _ = reference.act(state, Random(7, POLICY_STREAM), candidates=9, rule=file_rule, aggregate=aggregate)
            close(policy.act(state, candidates=9, rule=rule, aggregate=aggregate, seed=7), expected)
    assert np.array_equal(policy.act(state, seed=7), policy.act(state, **policy.choice, seed=7))
    assert policy.choice["rule"] == "nearest"
    drawn, values = policy.sample(state, candidates=4, seed=7)
    assert (drawn.shape, values.shape) == ((4, ACTION), (4,))


def test_episodes_equal_the_evaluator_s(hopper_runs):
    """The evaluator's own returns, bit for bit, with Python's MuJoCo and a second generator of initial states."""
    snapshot = hopper_runs / "seed0" / "snapshots" / "step_000000020.safetensors"
    scored = subprocess.run(["evaluator", "score", "--json", str(snapshot)], check=True, capture_output=True, timeout=600)
    expected = json.loads(scored.stdout)[0]["episodes"]
    policy = Policy.load(snapshot)
    model = mujoco.MjModel.from_xml_path(str(HOPPER))
    robots = [mujoco.MjData(model) for _ in expected]
    episodes = policy.begin([episode["seed"] for episode in expected])
    actual = [{"seed": episode["seed"], "return": 0.0, "length": 0} for episode in expected]
    for robot, episode in zip(robots, expected):
        random = Random(episode["seed"], RESET_STREAM)
        for state in (robot.qpos, robot.qvel):
            state += [random.between(-5e-3, 5e-3) for _ in state]
        mujoco.mj_forward(model, robot)
    alive = list(range(len(robots)))
    while alive:
        states = [np.concatenate([robots[i].qpos[1:], np.clip(robots[i].qvel, -10, 10)]) for i in alive]
        for i, action in zip(list(alive), episodes.act(states, rows=alive)):
            robot, x = robots[i], robots[i].qpos[0]
            robot.ctrl[:] = np.clip(action.astype(np.float64), -1, 1)
            mujoco.mj_step(model, robot, 4)
            velocity = (robot.qpos[0] - x) / (model.opt.timestep * 4)
            actual[i]["return"] += velocity + 1.0 - 1e-3 * sum(control * control for control in robot.ctrl)
            actual[i]["length"] += 1
            state = np.concatenate([robot.qpos[2:], robot.qvel])
            if not (abs(state) < 100).all() or robot.qpos[1] <= 0.7 or abs(robot.qpos[2]) >= 0.2 or actual[i]["length"] == 1000:
                alive.remove(i)
    assert actual == [{name: episode[name] for name in ("seed", "return", "length")} for episode in expected]
    assert min(episode["length"] for episode in actual) > 5


def test_a_row_depends_on_its_seed_alone(snapshots):
    policy, states = Policy.load(snapshots["quad"]), observations(200)
    actions = policy.act(states, seed=3)
    assert actions.dtype == np.float32 and actions.shape == (200, ACTION)
    for same in (policy.act(states, seed=range(3, 203)), policy.act(states, seed=np.arange(3, 203)),
                 policy.begin(range(3, 203)).act(states)):
        assert np.array_equal(actions, same)
    assert np.array_equal(actions[7], policy.act(states[7], seed=10))
    assert np.array_equal(actions[7], policy.begin(10).act(states[7:8])[0])
    assert not np.array_equal(policy.act(states), policy.act(states)), "fresh numbers without a seed"
    assert np.array_equal(policy.act(states[:2], seed=2**64 - 1)[1], policy.act(states[1], seed=0))

    one, all = policy.begin([3, 4, 5]), policy.begin([3, 4, 5])
    first = all.act(states[:3])
    assert not np.array_equal(first, all.act(states[:3])), "the noise goes on"
    assert np.array_equal(first[1], one.act(states[1:2], rows=[1])[0])
    assert np.array_equal(first[[2, 0]], one.act(states[[2, 0]], rows=np.array([2, 0])))
    assert len(one) == 3


def test_accepts_arrays_of_any_type(snapshots):
    policy, states = Policy.load(snapshots["scaled"]), observations(8)

    class Array:
        def __array__(self, dtype=None, copy=None):
            return states.astype(dtype or np.float64)

    expected = policy.act(states, seed=1)
    wide = np.zeros((16, 2 * OBSERVATION), np.float32)
    wide[::2, ::2] = states
    for same in (states.astype(np.float64), states.tolist(), Array(), np.asfortranarray(states), wide[::2, ::2]):
        assert np.array_equal(expected, policy.act(same, seed=1))
    assert policy.act(states[:0]).shape == (0, ACTION)
    assert policy.value(states[0], expected[0]).shape == ()
    assert policy.value(states[:0], expected[:0]).shape == (0,)


def test_properties(snapshots, hopper_runs):
    policy = Policy.load(str(snapshots["dql"]))
    assert (policy.observation_size, policy.action_size) == (OBSERVATION, ACTION)
    assert (policy.environment, policy.step, policy.kind, policy.precision) == ("my-robot", 12, "diffusion", "f32")
    assert policy.choice["rule"].startswith("softmax:")
    assert repr(policy).startswith("Policy(my-robot, diffusion after step 12, 11 -> 3 numbers, ")
    for same in (pickle.loads(pickle.dumps(policy)), copy.copy(policy), Policy.from_bytes(snapshots["dql"].read_bytes())):
        assert repr(same) == repr(policy)
        assert np.array_equal(same.act(observations(3), seed=1), policy.act(observations(3), seed=1))
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        assert Policy.load(snapshots["iql"], "bf16").precision == "f32"


@pytest.mark.filterwarnings("ignore:overflow")
def test_refuses_invalid_arguments(snapshots, tmp_path):
    policy, states = Policy.load(snapshots["quad"]), observations(3)
    bad = states.copy()
    bad[1, 4] = np.nan
    episodes = policy.begin([1, 2, 3])
    for message, call in {
        r"observations has shape \[3, 10\], but must have \[n, 11\] or \[11\]": lambda: policy.act(states[:, 1:]),
        r"observations has shape \[1, 3, 11\]": lambda: policy.act(states[None]),
        "observations, row 1: number 4 is NaN": lambda: policy.act(bad),
        "number 0 is inf": lambda: policy.act(states.astype(np.float64) * 1e300),
        "actions, row 0": lambda: policy.value(states, np.full((3, ACTION), np.nan)),
        "3 observations, but 2 actions": lambda: policy.value(states, np.zeros((2, ACTION))),
        "could not convert string": lambda: policy.act(["a"]),
        "seed must be an int .* sequence of 3": lambda: policy.act(states, seed=-1),
        "sequence of 3 of them, or None": lambda: policy.act(states, seed=[1, 2]),
        "candidates is 0, but must be from 1 to 10000": lambda: policy.act(states, candidates=0),
        "candidates is -1": lambda: policy.act(states, candidates=-1),
        'rule is "worst", not one of best': lambda: policy.act(states, rule="worst"),
        "temperature is -1": lambda: policy.act(states, rule="softmax:-1"),
        "`nearest` takes a value function": lambda: policy.act(states, rule="nearest"),
        'aggregate is "max", not one of mean, min and mean-minus-std:KAPPA': lambda: policy.act(states, aggregate="max"),
        "guidance is -1": lambda: policy.act(states, guidance=-1),
        "guidance takes a diffusion policy": lambda: Policy.load(snapshots["dtql"]).act(states, guidance=1),
        "no critics": lambda: Policy.load(snapshots["iql"]).value(states, np.zeros((3, ACTION))),
        "no candidates": lambda: Policy.load(snapshots["iql"]).act(states, candidates=2),
        "2 rows of observations for 3 episodes": lambda: episodes.act(states[:2]),
        "rows has 1 twice": lambda: episodes.act(states[:2], rows=[1, 1]),
        "rows has 3, but there are 3": lambda: episodes.act(states[:1], rows=[3]),
        "rows has -1": lambda: episodes.act(states[:1], rows=[-1]),
        'precision is "f16"': lambda: Policy.load(snapshots["quad"], "f16"),
        "is not a saved policy: .*\nhint: a policy is a file like": lambda: Policy.load(__file__),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(FileNotFoundError, match="nothing.*\nhint: "):
        Policy.load(tmp_path / "nothing")
    with pytest.raises(OSError):
        Policy.load(tmp_path)
    assert np.isfinite(episodes.act(states)).all(), "what was refused changed nothing"


def test_releases_the_interpreter_lock(snapshots):
    policy, states = Policy.load(snapshots["quad"]), observations(4000)
    thread = threading.Thread(target=policy.act, args=(states,), kwargs={"candidates": 100})
    ticks = 0
    thread.start()
    while thread.is_alive():
        time.sleep(0.001)
        ticks += 1
    assert ticks > 5, "this thread stood still"

    expected = [policy.act(states[i : i + 100], seed=i) for i in range(8)]
    actual = [None] * 8

    def act(i):
        actual[i] = policy.act(states[i : i + 100], seed=i)

    threads = [threading.Thread(target=act, args=(i,)) for i in range(8)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert all(np.array_equal(*pair) for pair in zip(expected, actual))


FORKS = """
import os, signal, sys
from quad_rl import Policy

policy = Policy.load(sys.argv[1])
state, action = [0.0] * policy.observation_size, [0.0] * policy.action_size

def in_a_fork(call):
    child = os.fork()
    if child == 0:
        signal.alarm(120)  # Ends a fork that waits forever.
        try:
            call()
        except RuntimeError as error:
            os._exit(7 if "spawn" in str(error) else 8)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

calls = [lambda: policy.act(state), lambda: policy.sample(state), lambda: policy.value(state, action),
         lambda: policy.begin([1]).act([state])]
assert [in_a_fork(call) for call in calls] == [0] * 4, "a fork may act if its parent has only loaded"
policy.act(state)
assert [in_a_fork(call) for call in calls] == [7] * 4
"""


def test_refuses_to_act_in_a_forked_process(snapshots):
    command = [sys.executable, "-W", "ignore", "-c", FORKS, str(snapshots["quad"])]
    ended = subprocess.run(command, capture_output=True, timeout=1200)
    assert ended.returncode == 0, ended.stderr.decode()


def test_an_exported_policy_describes_itself(hopper_runs, tmp_path):
    run, out = hopper_runs / "seed0", tmp_path / "policy.safetensors"
    command = ["learner", "export", str(run), "--step", "best", "--out", str(out), "--license", "CC0"]
    subprocess.run(command, check=True, capture_output=True, timeout=600)
    policy = Policy.load(out)
    about = policy.about
    assert about["step"] == policy.step and about["environment"] == "hopper" and about["version"] == version("quad-rl")
    assert about["data"]["license"] == "CC0" and about["score"]["episodes"] == 3 and about["judgment"] is None
    snapshot = Policy.load(run / "snapshots" / f"step_{policy.step:09}.safetensors")
    observation = np.zeros(policy.observation_size, np.float32)
    assert np.array_equal(policy.act(observation, seed=1), snapshot.act(observation, seed=1))
    assert "data" not in snapshot.about and snapshot.about["scaling"] is None
