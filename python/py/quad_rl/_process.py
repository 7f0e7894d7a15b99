"""Child processes, and the workers of `quad_rl.evaluate`, which are restarted."""

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

# A worker that ends within this many seconds of its start is restarted after a growing pause.
_SOON = 60.0
# Most such ends in a row.
_ENDS = 6
_WHY = "its standard error may say why"
# Looked up here, because a forked process should not load libraries.
_PRCTL, _SIGNAL = ctypes.CDLL(None).prctl, ctypes.CDLL(None).signal
_SIGNAL.argtypes = [ctypes.c_int, ctypes.c_void_p]
_PR_SET_PDEATHSIG = 1


def start(command: Sequence[str], *, ends_with_thread: bool = False, **settings: Any) -> subprocess.Popen[Any]:
    """Starts a program in a new session, so that a terminal's Ctrl-C reaches this process alone.

    ends_with_thread: the program gets SIGTERM when the thread that starts it ends.
    settings: other arguments of Popen. Standard error is this process's by default, if it has one.
    """
    if signal.getsignal(signal.SIGCHLD) == signal.SIG_IGN:
        # Some init scripts leave it so, which hides the exit codes of children. Python's own function works in the main
        # thread alone.
        _SIGNAL(signal.SIGCHLD, None)
    if "stderr" not in settings and not _has_stderr():
        settings["stderr"] = subprocess.DEVNULL
    ends = _end_with_thread if ends_with_thread else None
    return subprocess.Popen(command, start_new_session=True, preexec_fn=ends, **settings)


def exit_code(process: subprocess.Popen[Any]) -> int | None:
    """Waits for the exit code; None if another part of this process has taken it, which Popen reports as 0."""
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
    """True if this process has a standard error. Otherwise file descriptor 2 may be any file."""
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
        self._restart_at: float | None = None
        self.start()

    def start(self) -> None:
        self._restart_at = None
        self._started = time.monotonic()
        # One thread steps all environments of a worker, because they share NumPy's generator.
        environment = {"OMP_NUM_THREADS": "1", **os.environ, "RAYON_NUM_THREADS": "1"}
        command = [sys.executable, "-m", "quad_rl._worker"]
        self.process = start(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment)
        assert self.process.stdin and self.process.stdout
        self._out = self.process.stdout
        # A process that the environment has forked may hold the pipe open forever.
        os.set_blocking(self._out.fileno(), False)
        try:
            with self.process.stdin as pipe:
                for part in self._payload:
                    pipe.write(len(part).to_bytes(8, "little") + part)
        except BrokenPipeError:
            pass  # Its answer has the reason.

    def wait_until_ready(self) -> None:
        """Raises RuntimeError if it cannot make its environment."""
        output, ended = b"", False
        while not (output.endswith(b"\n") or ended):
            ended = self.process.poll() is not None
            output += self._read()
            time.sleep(0.02)
        _check(output)
        if ended:
            raise RuntimeError(f"a worker ended before it had an environment ({self._end()}); {_WHY}")

    def revive(self) -> None:
        """Restarts it if it was killed. Raises RuntimeError if it reports an error or has ended too often."""
        if self.process.poll() is None:
            return
        now = time.monotonic()
        if self._restart_at is None:
            _check(self._read())
            self._ends = self._ends + 1 if now - self._started < _SOON else 1
            if self._ends == _ENDS:
                raise RuntimeError(f"a worker ended {_ENDS} times in a row soon after its start ({self._end()}); {_WHY}")
            pause = 2**self._ends - 2  # 0, 2, 6, 14, 30
            self._restart_at = now + pause
            print(f"quad_rl: a worker ended ({self._end()}); restarting in {pause} s", file=sys.stderr)
        if now >= self._restart_at:
            self._out.close()
            self.start()

    def end(self) -> None:
        """Makes it deliver its scores and end."""
        self.process.terminate()

    def wait(self, until: float) -> None:
        """Waits until that time of the monotonic clock, then kills it."""
        try:
            self.process.wait(max(0.0, until - time.monotonic()))
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._out.close()

    def _read(self) -> bytes:
        """Its output since the last call."""
        return self._out.read() or b""

    def _end(self) -> str:
        """The cause of its end, e.g. "Killed"."""
        code = self.process.returncode
        return signal.strsignal(-code) or f"signal {-code}" if code < 0 else f"exit code {code}"


def _check(output: bytes) -> None:
    """Raises a worker's error. The last line of its output may be incomplete."""
    for line in output.split(b"\n")[:-1]:
        error = json.loads(line).get("error")
        if error is not None:
            raise RuntimeError(error)
