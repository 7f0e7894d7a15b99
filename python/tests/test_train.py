"""`quad_rl.train` is the program `learner train`, with its words."""

import io
import pathlib
import signal
import socket
import subprocess
import sys
import urllib.request

import pytest

import quad_rl
from conftest import arrays, train
from quad_rl import _train
from test_evaluate import Walk, children, wait

SMALL = {"algorithm": "iql", "agent": {"actor": {"hidden": [16]}, "critic.hidden": [16], "value.hidden": [16]}}


def test_it_trains_as_the_program_does(data, tmp_path, capsys):
    run = quad_rl.train(quad_rl.Dataset.from_arrays(**arrays()), run_dir=tmp_path / "run", steps=300, scale="actions,states",
                        set={"batch_size": 32}, **SMALL)
    flags = ["--agent", "actor={hidden=[16]}", "--agent", "critic={hidden=[16]}", "--agent", "value={hidden=[16]}"]
    flags += ["--algorithm", "iql", "--steps", "300", "--scale", "actions,states"]
    train(tmp_path / "program", data, "--task", "own-data", *flags)
    same = ["learner", "verify", run.folder, "--same-as", tmp_path / "program"]
    compared = subprocess.run(same, capture_output=True, text=True, timeout=60)
    assert compared.returncode == 0, compared.stdout + compared.stderr

    said = capsys.readouterr().err.splitlines()
    assert " transitions of " in said[0] and said[2].startswith("page: http://") and said[-1] == "training is done"
    assert run.policy().step == run.policy(300).step == 300 and run.scores == [] and run.metrics[-1]["step"] == 300
    assert urllib.request.urlopen(run.page, timeout=60).status == 200 and run.page == run.page
    with pytest.raises(FileNotFoundError, match="no snapshot after step 7"):
        run.policy(7)

    with pytest.raises(RuntimeError, match=r"^there is a run of another configuration .*steps: 300 there, 400 here.*\nhint: "):
        quad_rl.train(data, run_dir=run.folder, steps=400, scale="actions,states", set={"batch_size": 32}, **SMALL)
    with pytest.raises(RuntimeError, match=r"^cannot read .*nothing.hdf5(.|\n)*\nhint: "):
        quad_rl.train(tmp_path / "nothing.hdf5", run_dir=tmp_path / "other")
    with pytest.raises(RuntimeError, match="unexpected argument '--colour'"):
        quad_rl.train(data, run_dir=tmp_path / "other", colour=7, fresh=False)


SCRIPT = """
import ast, sys
import quad_rl
quad_rl.train(sys.argv[1], **ast.literal_eval(sys.argv[2]))
"""


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGKILL])
def test_it_ends_with_python_and_goes_on(by, data, tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
    arguments = {"run_dir": str(tmp_path / "run"), "env": "walk", "steps": 40, "eval_interval": 20, "episodes": 4}
    arguments |= {"listen": endpoint, **SMALL}
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, data, repr(arguments)], stderr=subprocess.PIPE, text=True)
    # Nobody scores, so it cannot end by itself.
    said = [process.stderr.readline()]
    while "waiting for the scores of" not in said[-1]:
        assert said[-1], said
        said.append(process.stderr.readline())
    (learner,) = children(process.pid)
    process.send_signal(by)
    rest = process.communicate(timeout=60)[1]
    if by == signal.SIGINT:
        assert "interrupted before the end" in rest and "\nhint: everything up to" in rest and "KeyboardInterrupt" in rest
    wait(lambda: not pathlib.Path("/proc", learner).exists() or ") Z" in pathlib.Path("/proc", learner, "stat").read_text())

    with quad_rl.Evaluators("walk", lambda seed: Walk(), connect=endpoint, workers=1):
        run = quad_rl.train(data, **arguments)
    assert [(row["step"], row["episodes"], row["complete"]) for row in run.scores] == [(20, 4, True), (40, 4, True)]


def test_a_bar_stays_in_its_place(monkeypatch):
    class Screen(io.StringIO):
        def isatty(self):
            return True

    said = [("INFO", "page: http://127.0.0.1:1/"), ("INFO", "step 50/100 (50 %), 9 seconds left"), ("WARN", "hot"),
            ("INFO", "step 100/100 (100 %), done"), ("INFO", "training is done"), ("", "error: no")]
    monkeypatch.setattr(_train, "_said", lambda process: said)
    monkeypatch.setattr(sys, "stderr", Screen())
    error = []
    _train._Display().follow(None, error)
    half, full = "█" * 10 + "░" * 10, "█" * 20
    bars = [f"{half} {said[1][1]}", f"{full} {said[3][1]}"]
    hot, done = "WARN hot".ljust(len(bars[0])), "training is done".ljust(len(bars[1]))
    assert sys.stderr.getvalue() == f"{said[0][1]}\n{bars[0]}\r{hot}\n{bars[1]}\r{done}\n" and error == ["error: no"]
