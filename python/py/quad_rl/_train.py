"""Training from Python, by the program `learner train`."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property
from os import PathLike
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TextIO

from quad_rl import _quad_rl
from quad_rl._dataset import Dataset
from quad_rl._process import exit_code, start
from quad_rl._runs import metrics, run_rows

_LINE = re.compile(r"\S+Z +([A-Z]+) (.*)")
_STEP = re.compile(r"step (\d+)/(\d+) ")
_PAGE = re.compile(r"page: (\S+)")
# Characters of the progress bar.
_BAR = 20


class Run:
    """A run's folder, from `train` or from elsewhere."""

    def __init__(self, folder: str | PathLike[str]) -> None:
        self.folder = Path(folder)

    def policy(self, step: int | None = None, precision: str = "f32") -> _quad_rl.Policy:
        """The policy of the snapshot after that gradient step, or of the last one.

        Raises FileNotFoundError if there is none; otherwise as `Policy.load`.
        """
        snapshots = sorted((self.folder / "snapshots").glob(f"step_{'*' if step is None else f'{step:09}'}.safetensors"))
        if not snapshots:
            which = "" if step is None else f" of step {step}"
            raise FileNotFoundError(f"{self.folder} has no snapshot{which}")
        return _quad_rl.Policy.load(snapshots[-1], precision)

    @property
    def scores(self) -> list[dict[str, Any]]:
        """Its rows of `runs`: a dictionary for each evaluation. Raises RuntimeError if it cannot be read."""
        return [row for row in run_rows(self.folder) if row["step"] is not None]

    @property
    def metrics(self) -> list[dict[str, float]]:
        """Its metrics, as of `quad_rl.metrics`: a dictionary for each step."""
        return metrics(self.folder)

    @cached_property
    def page(self) -> str:
        """Address of its web page, which `learner page` serves until this process ends."""
        answer: SimpleQueue[str | Exception] = SimpleQueue()
        # The program ends with the thread that starts it, which may not be the caller's.
        threading.Thread(target=_serve_page, args=(self.folder, answer), daemon=True).start()
        page = answer.get()
        if isinstance(page, Exception):
            raise page
        return page

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"


def _serve_page(folder: Path, answer: SimpleQueue[str | Exception]) -> None:
    """Answers with the address or an error, and reads the program's log to its end."""
    try:
        process = _start("page", str(folder), "--http=127.0.0.1:0")
        lines = []
        for _, text in _log(process):
            if page := _PAGE.match(text):
                answer.put(page[1])
            lines.append(text)
        raise _error(exit_code(process), lines)
    except (RuntimeError, OSError) as error:
        answer.put(error)


def train(
    dataset: Dataset | str | PathLike[str] | Sequence[Dataset | str | PathLike[str]] = (),
    *,
    run_dir: str | PathLike[str],
    algorithm: str | None = None,
    steps: int | None = None,
    online_steps: int | None = None,
    normalize: str | None = None,
    task: str | None = "own-data",
    **options: Any,
) -> Run:
    """Runs `learner train` to the end of training and its evaluations, and shows its progress.

    dataset: an argument of `--dataset`, or a Dataset, which the run's folder keeps as a file; or a list of these, joined in order.
        Without one there is no task by default: `algorithm="sac", env="NAME"` learns from evaluators' episodes alone.
    run_dir: folder of the run. If it contains a run of the same configuration, that run continues.
    algorithm, steps, online_steps, normalize, task: as in `learner train --help`.
    options: any other option, with _ for -: `eval_interval=5000`, `fresh=True`. A dictionary repeats an option:
        `agent={"tau": 0.5}, set={"batch_size": 64}`.

    An interrupt (Ctrl-C) stops the learner after a checkpoint, and the same call continues the run; a second one stops it at
    once. The learner also stops with this process. Raises RuntimeError with the learner's error and hint.
    """
    files = [dataset] if isinstance(dataset, (Dataset, str, PathLike)) else list(dataset)
    if not files and task == "own-data":
        task = None
    own = {"task": task, "algorithm": algorithm, "steps": steps, "online_steps": online_steps, "normalize": normalize}
    own["run_dir"] = os.fspath(run_dir)
    with ExitStack() as stack:
        paths = [stack.enter_context(_kept(file, Path(run_dir))) if isinstance(file, Dataset) else file for file in files]
        display = _Display()
        process = _start("train", *(f"--dataset={os.fspath(path)}" for path in paths), *_flags(own | options))
        error: list[str] = []
        try:
            display.follow(process, error)
        except BaseException:
            process.terminate()  # Writes a checkpoint.
            try:
                display.follow(process, error)
            except KeyboardInterrupt:
                process.terminate()  # At once.
            process.wait()
            display.say("\n".join(error))
            raise
    code = exit_code(process)
    if code != 0:
        raise _error(code, error)
    return Run(run_dir)


@contextmanager
def _kept(dataset: Dataset, folder: Path) -> Iterator[Path]:
    """The data as a file in a run's folder, which stays there if a run begins with it. Other data has another name."""
    with tempfile.TemporaryDirectory() as temporary:
        saved = Path(temporary, "dataset.hdf5")
        dataset.save(saved)
        path = folder / f"dataset-{hashlib.sha256(saved.read_bytes()).hexdigest()[:12]}.hdf5"
        folder.mkdir(parents=True, exist_ok=True)
        shutil.move(saved, path)
    try:
        yield path
    finally:
        config = folder / "config.toml"
        if config.exists() and path.name in config.read_text(encoding="utf-8"):
            if not path.exists():  # With `fresh`, the learner has renamed the folder in which it was.
                dataset.save(path)
        else:
            path.unlink(missing_ok=True)
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()


class _Display:
    """Shows a learner's log. In a notebook or on a terminal, its progress is a bar. A failure to show it does not stop the
    learner."""

    def __init__(self) -> None:
        notebook = type(sys.stdout).__module__ == "ipykernel.iostream"
        self._out: TextIO | None = sys.stdout if notebook else sys.stderr
        if self._out is not None and self._out.closed:
            self._out = None
        self._is_terminal = self._out is not None and self._out.isatty()
        self._draws = notebook or self._is_terminal
        self._bar = ""

    def follow(self, process: subprocess.Popen[str], error: list[str]) -> None:
        """Shows the log until the process ends. Lines that are not the log's are the error, and not shown."""
        for level, text in _log(process):
            step = _STEP.match(text)
            if not level:
                error.append(text)
            elif step and self._draws:
                done = _BAR * int(step[1]) // int(step[2])
                text = f"{'█' * done}{'░' * (_BAR - done)} {text}"
                # A wrapped line cannot be overwritten.
                self._write(text[: shutil.get_terminal_size().columns - 1] if self._is_terminal else text)
            else:
                self.say(text if level == "INFO" else f"{level} {text}")

    def say(self, text: str) -> None:
        self._write(text, "\n")
        self._bar = ""

    def _write(self, text: str, end: str = "") -> None:
        if self._out is None:
            return
        begin = "\r" if self._bar else ""
        try:
            print(begin + text.ljust(len(self._bar)), end=end, file=self._out, flush=True)
        except (OSError, ValueError):  # It was closed.
            self._out = None
        self._bar = text


def learner() -> str:
    """The learner beside this Python, otherwise the one on the PATH. Raises RuntimeError if there is none."""
    path = os.pathsep.join([sysconfig.get_path("scripts"), os.environ.get("PATH", "")])
    program = shutil.which("learner", path=path)
    if program is None:
        raise RuntimeError(f"there is no program `learner` in {path}\nhint: the wheel of deploy/wheel.sh contains it")
    return program


def _start(*arguments: str) -> subprocess.Popen[str]:
    return start(
        [learner(), *arguments],
        ends_with_thread=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        # RUST_LOG could hide lines that are parsed here.
        env={name: value for name, value in os.environ.items() if name != "RUST_LOG"},
    )


def _log(process: subprocess.Popen[str]) -> Iterator[tuple[str, str]]:
    """Level and text of each line of its log; other lines have no level."""
    assert process.stderr
    for line in process.stderr:
        logged = _LINE.fullmatch(line.rstrip("\n"))
        yield (logged[1], logged[2]) if logged else ("", line.rstrip("\n"))


def _error(code: int | None, lines: list[str]) -> RuntimeError:
    if code is None:
        how = "the learner's exit code is unknown: another part of this process has waited for it, or ignores SIGCHLD"
    elif code < 0:
        how = f"the learner was killed by {signal.Signals(-code).name}"
    else:
        how = f"the learner ended with exit code {code}"
    return RuntimeError("\n".join(lines).removeprefix("error: ") or how)


def _flags(options: Mapping[str, Any]) -> Iterator[str]:
    for name, value in options.items():
        flag = "--" + name.replace("_", "-")
        if value is True:
            yield flag
        elif isinstance(value, Mapping):
            yield from (f"{flag}={key}={_toml(one)}" for key, one in value.items())
        elif value is not None and value is not False:
            yield f"{flag}={value}"


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + "}"
    return json.dumps(value)
