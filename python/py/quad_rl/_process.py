"""Processes that this package starts: any; and a worker of `quad_rl.evaluate`, started, started again, ended."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

# A worker that ends so soon after its start, seconds, is started again after a growing pause.
_SOON = 60.0
# So many such ends in a row are the last.
_ENDS = 6
_WHY = "its standard error may say why"
# Found here, since a process that was just forked should look for nothing.
_PRCTL, _SIGNAL = ctypes.CDLL(None).prctl, ctypes.CDLL(None).signal
_SIGNAL.argtypes = [ctypes.c_int, ctypes.c_void_p]
_PR_SET_PDEATHSIG = 1


def start(command: Sequence[str], *, ends_with_thread: bool = False, **settings: Any) -> subprocess.Popen[Any]:
    """Starts a program, in a session of its own: a terminal's Ctrl-C is this process's to pass on.

    ends_with_thread: the system ends the program in order when the thread that starts it is gone.
    settings: what else Popen takes. Standard error is this process's by default, if it has one.
    """
    if signal.getsignal(signal.SIGCHLD) == signal.SIG_IGN:
        # Some init scripts leave it so, and then nobody learns how a child has ended. Python's own function would be for the
        # main thread alone.
        _SIGNAL(signal.SIGCHLD, None)
    if "stderr" not in settings and not _has_stderr():
        settings["stderr"] = subprocess.DEVNULL
    ends = _end_with_thread if ends_with_thread else None
    return subprocess.Popen(command, start_new_session=True, preexec_fn=ends, **settings)


def exit_code(process: subprocess.Popen[Any]) -> int | None:
    """Waits for its end, and gives its exit code; None if another part of this process took it, which Popen takes for 0."""
    try:
        ended = os.waitid(os.P_PID, process.pid, os.WEXITED)
    except ChildProcessError:
        return None
    assert ended
    process.returncode = ended.si_status if ended.si_code == os.CLD_EXITED else -ended.si_status
    return process.returncode


def _end_with_thread() -> None:
    _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _has_stderr() -> bool:
    """Whether this process was started with a standard error, and has not closed it. Else number 2 may be any file."""
    try:
        os.fstat(2)
    except OSError:
        return False
    return sys.__stderr__ is not None


class Worker:
    """Runs `python -m quad_rl._worker`, which reads `payload` from its standard input."""

    def __init__(self, payload: list[bytes]) -> None:
        self._payload = payload
        self._ends = 0
        self._again: float | None = None
        self.start()

    def start(self) -> None:
        self._again = None
        self._started = time.monotonic()
        # One thread moves all of a worker's environments, whatever this process uses: they share NumPy's generator.
        environment = {"OMP_NUM_THREADS": "1", **os.environ, "RAYON_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "quad_rl._worker"]
        self.process = start(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        assert self.process.stdin and self.process.stdout
        self._out = self.process.stdout
        # A process that the worker's environment has forked holds the pipe, too: it may never end.
        os.set_blocking(self._out.fileno(), False)
        try:
            with self.process.stdin as pipe:
                for part in self._payload:
                    pipe.write(len(part).to_bytes(8, "little") + part)
        except BrokenPipeError:
            pass  # It has ended, which its answer tells.

    def wait_until_ready(self) -> None:
        """Raises RuntimeError if it cannot make its environment."""
        said, ended = b"", False
        while not (said.endswith(b"\n") or ended):
            ended = self.process.poll() is not None
            said += self._said()
            time.sleep(0.02)
        _check(said)
        if ended:
            raise RuntimeError(f"a worker ended before it had an environment ({self._end()}); {_WHY}")

    def revive(self) -> None:
        """Starts it again if it was killed. Raises RuntimeError if it cannot work, or has ended too often."""
        if self.process.poll() is None:
            return
        now = time.monotonic()
        if self._again is None:
            _check(self._said())
            self._ends = self._ends + 1 if now - self._started < _SOON else 1
            if self._ends == _ENDS:
                raise RuntimeError(f"a worker ended {_ENDS} times in a row soon after its start ({self._end()}); {_WHY}")
            pause = 2**self._ends - 2  # 0, 2, 6, 14, 30
            self._again = now + pause
            print(f"quad_rl: a worker ended ({self._end()}); it is started again in {pause} s", file=sys.stderr)
        if now >= self._again:
            self._out.close()
            self.start()

    def end(self) -> None:
        """Tells it to deliver its scores and end."""
        self.process.terminate()

    def wait(self, until: float) -> None:
        """Waits until that time of the monotonic clock, then kills it."""
        try:
            self.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._out.close()

    def _said(self) -> bytes:
        """What it has said since it was asked last."""
        return self._out.read() or b""

    def _end(self) -> str:
        """How it ended, e.g. "Killed"."""
        code = self.process.returncode
        return signal.strsignal(-code) or f"signal {-code}" if code < 0 else f"exit code {code}"


def _check(said: bytes) -> None:
    """Raises what a worker has said is wrong. The last line may be cut off."""
    for line in said.split(b"\n")[:-1]:
        error = json.loads(line).get("error")
        if error is not None:
            raise RuntimeError(error)
