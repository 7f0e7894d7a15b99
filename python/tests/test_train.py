"""`quad_rl.train` runs the program `learner train`."""

import io
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
import urllib.request

import pytest

import quad_rl
from conftest import arrays, free_endpoint, train
from quad_rl import _train
from test_evaluate import Walk, children, has_ended, wait

SMALL = {"algorithm": "iql", "agent": {"actor": {"hidden": [16]}, "critic.hidden": [16], "value.hidden": [16]}}


def test_trains_like_the_program(data, tmp_path, capsys):
    run = quad_rl.train(quad_rl.Dataset.from_arrays(**arrays()), run_dir=tmp_path / "run", steps=300, normalize="actions,observations",
                        set={"batch_size": 32}, **SMALL)
    flags = ["--agent", "actor={hidden=[16]}", "--agent", "critic={hidden=[16]}", "--agent", "value={hidden=[16]}"]
    flags += ["--algorithm", "iql", "--steps", "300", "--normalize", "actions,observations"]
    train(tmp_path / "program", data, "--task", "own-data", *flags)
    same = ["learner", "verify", run.folder, "--same-as", tmp_path / "program"]
    compared = subprocess.run(same, capture_output=True, text=True, timeout=600)
    assert compared.returncode == 0, compared.stdout + compared.stderr

    said = capsys.readouterr().err.splitlines()
    assert " transitions of " in said[0] and said[2].startswith("page: http://") and said[-1] == "training is done"
    assert run.policy().step == run.policy(300).step == 300 and run.scores == [] and run.metrics[-1]["step"] == 300
    assert urllib.request.urlopen(run.page, timeout=600).status == 200 and run.page == run.page
    with pytest.raises(FileNotFoundError, match="no snapshot of step 7"):
        run.policy(7)

    with pytest.raises(RuntimeError, match=r"^there is a run of another configuration .*steps: 300 there, 400 here.*\nhint: "):
        quad_rl.train(data, run_dir=run.folder, steps=400, normalize="actions,observations", set={"batch_size": 32}, **SMALL)
    with pytest.raises(RuntimeError, match=r"^cannot read .*nothing.hdf5(.|\n)*\nhint: "):
        quad_rl.train(tmp_path / "nothing.hdf5", run_dir=tmp_path / "other")
    with pytest.raises(RuntimeError, match="unexpected argument '--color'"):
        quad_rl.train(data, run_dir=tmp_path / "other", color=7, fresh=False)


def test_the_run_keeps_the_data_that_it_has_learned_from(tmp_path):
    def kept(folder):
        return sorted(path.name for path in folder.glob("dataset-*.hdf5"))

    first, other = (quad_rl.Dataset.from_arrays(**arrays(seed)) for seed in (0, 1))
    run = quad_rl.train(first, run_dir=tmp_path / "run", steps=2, **SMALL)
    (name,) = kept(run.folder)
    data = run.folder / name
    assert f'"{data}"' in (run.folder / "config.toml").read_text()
    first.save(tmp_path / "same.hdf5")
    assert data.read_bytes() == (tmp_path / "same.hdf5").read_bytes()
    quad_rl.train(first, run_dir=run.folder, steps=2, **SMALL)
    with pytest.raises(RuntimeError, match="another configuration"):
        quad_rl.train(other, run_dir=run.folder, steps=2, **SMALL)
    assert kept(run.folder) == [name]
    quad_rl.train(other, run_dir=run.folder, steps=2, fresh=True, **SMALL)
    (name,) = kept(run.folder)
    assert name != data.name and name in (run.folder / "config.toml").read_text()
    both = quad_rl.train([data.parent / name, first], run_dir=tmp_path / "both", steps=2, **SMALL)
    config = (both.folder / "config.toml").read_text()
    assert config.count("[[dataset.files]]") == 2 and f'"{both.folder / kept(both.folder)[0]}"' in config
    with pytest.raises(RuntimeError, match="unexpected argument"):
        quad_rl.train(first, run_dir=tmp_path / "refused", color=7)
    assert not (tmp_path / "refused").exists()


SCRIPT = """
import ast, sys
import quad_rl
quad_rl.train(sys.argv[1], **ast.literal_eval(sys.argv[2]))
"""


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGKILL])
def test_stops_with_python_and_resumes(by, data, tmp_path):
    endpoint = free_endpoint()
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
    rest = process.communicate(timeout=600)[1]
    if by == signal.SIGINT:
        assert "interrupted before the end" in rest and "\nhint: everything up to" in rest and "KeyboardInterrupt" in rest
    wait(lambda: has_ended(learner))

    with quad_rl.Evaluators("walk", lambda seed: Walk(), connect=endpoint, workers=1):
        run = quad_rl.train(data, **arguments)
    assert [(row["step"], row["episodes"], row["complete"]) for row in run.scores] == [(20, 4, True), (40, 4, True)]


def run(script, *arguments, launcher=(), **environment):
    """The output of a script."""
    command = [*launcher, sys.executable, "-c", script, *map(str, arguments)]
    ended = subprocess.run(command, cwd=pathlib.Path(__file__).parent, capture_output=True, text=True, timeout=600,
                           env=os.environ | environment)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_finds_the_page_whatever_the_log_level(data, tmp_path):
    train(tmp_path / "run", data, "--task", "own-data", "--steps", "1")
    script = "import sys, quad_rl; print(quad_rl.Run(sys.argv[1]).page)"
    assert run(script, tmp_path / "run", RUST_LOG="warn").startswith("http://127.0.0.1:")

    # It stays when the thread that asked for it is gone.
    asked = quad_rl.Run(tmp_path / "run")
    thread = threading.Thread(target=lambda: asked.page)
    thread.start()
    thread.join()
    time.sleep(1)
    assert urllib.request.urlopen(asked.page, timeout=600).status == 200
    with pytest.raises(RuntimeError, match="there is no folder .*nothing(.|\n)*hint: "):
        quad_rl.Run(tmp_path / "nothing").page


FAILS = """
import ctypes, os, signal, sys, threading, time
import quad_rl

def train(dataset, **arguments):
    try:
        print(quad_rl.train(dataset, run_dir=sys.argv[2], fresh=True, **arguments))
    except RuntimeError as error:
        print(error)

def children():
    return [child for task in os.listdir("/proc/self/task") for child in open(f"/proc/self/task/{task}/children").read().split()]

def kill(ignored):
    while not children():
        time.sleep(0.01)
    if ignored:
        ctypes.CDLL(None).signal(signal.SIGCHLD, 1)
    os.kill(int(children()[0]), signal.SIGKILL)

train("/nowhere.hdf5")
for ignored in (False, True):
    killer = threading.Thread(target=kill, args=(ignored,))
    killer.start()
    train(sys.argv[1], steps=10**9)
    killer.join()
train(sys.argv[1], steps=1)
"""


def test_a_failure_is_an_error_even_if_sigchld_is_ignored(data, tmp_path):
    said = run(FAILS, data, tmp_path / "run", launcher=["env", "--ignore-signal=CHLD"])  # As some init scripts start programs.
    first, killed, unknown, success = [line for line in said.splitlines() if not line.startswith((" ", "hint:"))]
    assert first.startswith("cannot read /nowhere.hdf5") and killed == "the learner was killed by SIGKILL", said
    assert unknown.startswith("the learner's exit code is unknown") and success == f"Run('{tmp_path / 'run'}')", said


CLOSED = """
import sys
files = [open(f"{sys.argv[2]}/file{number}", "w") for number in range(3)]
import quad_rl, test_evaluate
assert [file.fileno() for file in files] == [0, 1, 2] and sys.stderr is None
run = quad_rl.train(sys.argv[1], run_dir=f"{sys.argv[2]}/run", steps=1)
run.page
with quad_rl.Evaluators("walk", lambda seed: test_evaluate.Walk(), connect="tcp/127.0.0.1:1", workers=1):
    pass
files[0].write("done")
"""


def test_works_without_standard_streams_and_writes_to_no_other_file(data, tmp_path):
    run(CLOSED, data, tmp_path, launcher=["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh"])
    assert [(tmp_path / f"file{number}").read_text() for number in range(3)] == ["done", "", ""]


def test_a_failure_to_show_progress_does_not_stop_the_learner(monkeypatch):
    class Gone(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

    monkeypatch.setattr(_train, "_log", lambda process: [("INFO", "page: http://127.0.0.1:1/"), ("", "error: no")])
    closed = io.StringIO()
    closed.close()
    for stream in (Gone(), closed, None):
        monkeypatch.setattr(sys, "stderr", stream)
        error = []
        _train._Display().follow(None, error)
        assert error == ["error: no"]


def test_the_bar_overwrites_its_line(monkeypatch):
    class Screen(io.StringIO):
        def isatty(self):
            return True

    said = [("INFO", "page: http://127.0.0.1:1/"), ("INFO", "step 50/100 (50 %), 9 seconds left"), ("WARN", "hot"),
            ("INFO", "step 100/100 (100 %), done"), ("INFO", "training is done"), ("", "error: no")]
    monkeypatch.setattr(_train, "_log", lambda process: said)
    monkeypatch.setattr(sys, "stderr", Screen())
    error = []
    _train._Display().follow(None, error)
    half, full = "█" * 10 + "░" * 10, "█" * 20
    bars = [f"{half} {said[1][1]}", f"{full} {said[3][1]}"]
    hot, done = "WARN hot".ljust(len(bars[0])), "training is done".ljust(len(bars[1]))
    assert sys.stderr.getvalue() == f"{said[0][1]}\n{bars[0]}\r{hot}\n{bars[1]}\r{done}\n" and error == ["error: no"]
