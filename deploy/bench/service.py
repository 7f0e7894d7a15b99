"""Memory, stalls, delays and start-up of a learner and four evaluators, as real processes on this machine.

    service.py [--seconds S] [--pairs N] [--dataset FILE]     about four minutes, unless told otherwise

Wants release builds of both, and two processor cores or more. The learner trains on one thread, and the evaluators are
bound to all cores but the first, so that this thread always finds a core of its own: what is left is what they cost it
through messages. The four come and go while it trains, so that spells with and without them lie side by side. The
networks are of the paper's sizes, with one next action per state. Prints a table.
"""

import argparse
import contextlib
import datetime
import json
import os
import re
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from urllib.request import urlopen

BIN = Path("target/release")
EVALUATORS = 4
# A hundred times as often as the task is evaluated, so that a short run shows some snapshots.
EVAL_INTERVAL = 200
# Seconds at the start of a phase that do not count, while evaluators start or leave.
SETTLE = 3
TASK = ["--task", "hopper-medium-replay-v2", "--agent", "samples=1"]
CORES = sorted(os.sched_getaffinity(0))


@contextlib.contextmanager
def process(command, log, cores):
    environment = os.environ | {"RAYON_NUM_THREADS": "1", "RUST_LOG": "quad_learner=debug,quad_evaluator=debug"}
    with open(log, "w") as out:
        child = subprocess.Popen(
            command, stdout=out, stderr=out, env=environment, preexec_fn=lambda: os.sched_setaffinity(0, cores)
        )
        try:
            yield child
        finally:
            child.terminate()
            child.wait(timeout=30)


def resident(pid):
    """Resident memory in MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(re.search(r"VmRSS:\s+(\d+)", status)[1]) / 1024


def stamps(log, text):
    """{step: time} of the log lines that contain `text`."""
    found = {}
    for line in Path(log).read_text().splitlines():
        if text in line and (step := re.search(r"\bstep=(\d+)", line)):
            found.setdefault(int(step[1]), datetime.datetime.fromisoformat(line.split()[0]).timestamp())
    return found


def metric(page, name):
    return float(re.search(rf"^{name}(?:{{[^}}]*}})? (\S+)$", page, re.MULTILINE)[1])


class Learner:
    """A learner's /metrics, and the memory of its processes."""

    def __init__(self, pid, address):
        self.pid, self.address = pid, address
        self.memory, self.evaluator_memory = [], 0.0

    def look(self):
        """Now, gradient steps so far, and seconds spent in them."""
        page = urlopen(f"http://{self.address}/metrics", timeout=5).read().decode()
        sums = ("quad_learner_gradient_steps_total", "quad_learner_step_duration_seconds_sum")
        return (time.time(), *(metric(page, name) for name in sums))

    def spell(self, seconds, evaluators):
        """Seconds per gradient step for a while, and the share of it that was outside the steps."""
        time.sleep(SETTLE)
        start, first, before = self.look()
        while time.time() < start + seconds:
            time.sleep(0.5)
            self.memory.append(resident(self.pid))
            self.evaluator_memory = max([self.evaluator_memory, *(resident(x.pid) for x in evaluators)])
        end, last, after = self.look()
        return (end - start) / (last - first), 1 - (after - before) / (end - start)


def train(folder, dataset, seconds, pairs):
    """A learner on one thread, spells without and with evaluators in turns; what was seen of it."""
    run = Path(folder) / "run"
    command = [BIN / "learner", "train", *TASK, "--dataset", dataset, "--run-dir", run]
    command += ["--steps", "1000000", "--listen", "tcp/127.0.0.1:0", "--eval-interval", str(EVAL_INTERVAL)]
    seen = {"alone": [], "together": [], "outside": [], "delays": [], "begin": []}
    with process(command, f"{run}.learner.log", CORES) as child:
        while not (run / "endpoints.json").exists():
            if child.poll() is not None:
                raise SystemExit(Path(f"{run}.learner.log").read_text())
            time.sleep(0.05)
        endpoints = json.loads((run / "endpoints.json").read_text())
        learner = Learner(child.pid, endpoints["metrics"])
        serve = [BIN / "evaluator", "serve", "--connect", endpoints["zenoh"][0]]
        for pair in range(pairs):
            seen["alone"].append(learner.spell(seconds, [])[0])
            logs = [f"{run}.evaluator{pair}.{i}.log" for i in range(EVALUATORS)]
            with contextlib.ExitStack() as stack:
                evaluators = [stack.enter_context(process(serve, log, CORES[1:])) for log in logs]
                pace, outside = learner.spell(seconds, evaluators)
            seen["together"].append(pace)
            seen["outside"].append(outside)
            taken = stamps(f"{run}.learner.log", "snapshot")
            for log in logs:
                arrived, begun = stamps(log, "weights arrived"), stamps(log, "evaluating")
                seen["delays"] += [arrived[step] - taken[step] for step in arrived if step in taken]
                seen["begin"] += [begun[step] - arrived[step] for step in begun if step in arrived]
        seen["steps"] = int(learner.look()[1])
    return seen | {"memory": learner.memory, "evaluator_memory": learner.evaluator_memory}


def start_up(folder, dataset):
    """Seconds of a whole process that makes one step."""
    begin = time.perf_counter()
    subprocess.run(
        [BIN / "learner", "train", *TASK, "--dataset", dataset, "--steps", "1", "--eval-interval", "0"]
        + ["--run-dir", Path(folder) / f"start-{time.time_ns()}"],
        check=True,
        capture_output=True,
    )
    return time.perf_counter() - begin


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=15.0, help="of each spell")
    parser.add_argument("--pairs", type=int, default=6, help="of spells without and with evaluators")
    parser.add_argument("--dataset", type=Path, default=Path("data/hopper-demo.hdf5"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        start = statistics.median(start_up(folder, arguments.dataset) for _ in range(5))
        seen = train(folder, arguments.dataset, arguments.seconds, arguments.pairs)
    alone, together = (1e3 * statistics.median(seen[which]) for which in ("alone", "together"))
    cost = 100 * statistics.median(b / a - 1 for a, b in zip(seen["alone"], seen["together"], strict=True))
    delays, begin, memory = sorted(seen["delays"]), sorted(seen["begin"]), seen["memory"]
    outside, pairs = 100 * max(seen["outside"]), arguments.pairs
    ms = lambda times: f"median {1e3 * statistics.median(times):.0f} ms, most {1e3 * times[-1]:.0f} ms"
    rows = [
        ("learner, start to end of a process that makes one step", f"{start:.2f} s"),
        (
            f"gradient step alone / with four evaluators, medians of {pairs} spells of each, and of the pairs' ratios",
            f"{alone:.2f} / {together:.2f} ms ({cost:+.1f} %)",
        ),
        ("training thread's time outside the steps, with four evaluators, most of a spell", f"{outside:.2f} %"),
        (f"snapshot taken → at an evaluator, {len(delays)} arrivals", ms(delays)),
        (f"weights at an evaluator → its episodes begin, {len(begin)} times", ms(begin)),
        (
            f"learner's memory, after a tenth / at the end of {seen['steps']} steps",
            f"{memory[len(memory) // 10]:.0f} / {memory[-1]:.0f} MB",
        ),
        ("largest evaluator's memory", f"{seen['evaluator_memory']:.0f} MB"),
    ]
    print("| processes | |\n|---|---|")
    for name, value in rows:
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()
