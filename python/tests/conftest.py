"""Shared data and small policies, made once by the package's programs."""

import json
import os
import random
import socket
import subprocess
import time

import numpy as np
import pytest

import quad_rl

# Tests have servers on this machine, which no proxy reaches.
os.environ["no_proxy"] = ",".join(filter(None, [os.environ.get("no_proxy") or os.environ.get("NO_PROXY"), "127.0.0.1"]))
OBSERVATION, ACTION = 11, 3  # Hopper's.
SMALL = '{hidden=[24, 24], activation="%s", norm=%s}'
# Each with what it is to cover: every reverse process, rule, activation; a layer norm, a scaling, a mean.
POLICIES = {
    "quad": [],
    "norm": ["--agent", "critic=" + SMALL % ("silu", "true"), "--agent", "actor=" + SMALL % ("tanh", "true")],
    "scaled": ["--normalize", "actions,observations"],
    "dql": ["--algorithm", "dql", "--agent", "temperature=0.1"],
    "align-iql": ["--algorithm", "align-iql"],
    "iql": ["--algorithm", "iql"],
    "cql": ["--algorithm", "cql"],
    "dtql": ["--algorithm", "dtql", "--agent", "critic={hidden=[24, 24], activation=\"mish\", norm=true, norm_epsilon=\"torch\"}",
             "--agent", "candidates=20", "--agent", "temperature=0.1"],
}


def arrays(seed=0, n=1200):
    """Random steps; an episode ends every 100 rows, some terminate in between."""
    rng, row = np.random.default_rng(seed), np.arange(n)
    return {
        "observations": rng.normal(3.0, 2.0, (n, OBSERVATION)),
        "actions": rng.uniform(-1, 1, (n, ACTION)),
        "rewards": rng.normal(size=n),
        "terminations": row % 250 == 120,
        "truncations": row % 100 == 99,
    }


def free_endpoint():
    """A free port, which stays free: the system itself gives ports from 32,768 on to those who want any, or who connect."""
    while True:
        endpoint = "127.0.0.1", random.randrange(20_000, 30_000)
        with socket.socket() as tried:
            if tried.connect_ex(endpoint):
                return "tcp/{}:{}".format(*endpoint)


def train(folder, data, *arguments, layers=True):
    """The last snapshot of a run, by default with narrow networks."""
    command = ["learner", "train", "--dataset", str(data), "--run-dir", str(folder), "--set", "batch_size=32"]
    narrow = ["--agent", "critic=" + SMALL % ("mish", "false"), "--agent", "actor=" + SMALL % ("mish", "false")]
    given = [a.split("=")[0] for a in arguments]
    narrow = [x for pair in zip(narrow[::2], narrow[1::2]) if layers and pair[1].split("=")[0] not in given for x in pair]
    subprocess.run([*command, *narrow, *arguments], check=True, capture_output=True, timeout=600)
    return sorted((folder / "snapshots").iterdir())[-1]


@pytest.fixture(scope="session")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "data.hdf5"
    quad_rl.Dataset.from_arrays(**arrays()).save(path)
    return path


@pytest.fixture(scope="session")
def snapshots(tmp_path_factory, data):
    """The file of a policy of each kind."""
    folder = tmp_path_factory.mktemp("runs")
    own = ["--task", "own-data", "--env", "my-robot", "--steps", "12"]
    return {name: train(folder / name, data, *own, *flags) for name, flags in POLICIES.items()}


@pytest.fixture(scope="session")
def hopper_runs(tmp_path_factory, data):
    """A folder with two evaluated runs of Hopper, seeds 0 and 1."""
    folder = tmp_path_factory.mktemp("hopper")
    for seed in (0, 1):
        run = folder / f"seed{seed}"
        arguments = ["learner", "train", "--task", "hopper-demo", "--dataset", str(data), "--run-dir", str(run), "--steps", "20",
                     "--eval-interval", "10", "--episodes", "3", "--seed", str(seed), "--listen", "tcp/127.0.0.1:0"]
        learner = subprocess.Popen(arguments, stderr=subprocess.PIPE)
        until = time.monotonic() + 600
        while not (run / "endpoints.json").exists():
            assert learner.poll() is None and time.monotonic() < until, learner.stderr.read()
            time.sleep(0.05)
        endpoint = json.loads((run / "endpoints.json").read_text())["zenoh"][0]
        evaluator = subprocess.Popen(["evaluator", "serve", "--connect", endpoint], stderr=subprocess.DEVNULL)
        try:
            _, log = learner.communicate(timeout=600)
            assert learner.returncode == 0, log.decode()
        finally:
            for process in (learner, evaluator):
                process.kill()
                process.wait()
    return folder
