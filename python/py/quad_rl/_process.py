"""A worker of `quad_rl.evaluate` as the process that starts it sees it: started, started again, ended."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

# A worker that ends so soon after its start, seconds, is started again after a growing pause.
_SOON = 60.0
# So many such ends in a row are the last.
_ENDS = 6
_WHY = "its standard error may say why"


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
        # A session of its own: a terminal's Ctrl-C is this process's to pass on.
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, start_new_session=True
        )
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
