"""Memory, stalls, delays and start-up of a learner and four evaluators, as real processes on this machine.

    service.py [--steps N] [--dataset FILE]     about five minutes with the default of 600 steps

Wants release builds of both, and two processor cores or more. The learner trains on one thread, and the evaluators are
bound to all cores but the first, so that this thread always finds a core of its own: what is left is what they cost it
through messages. The networks are of the paper's sizes, with one next action per state. Prints a table.
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
# A hundred times as often as the preset evaluates, so that a short run shows some snapshots.
EVAL_INTERVAL = 200
PRESET = ["--preset", "hopper-medium-replay-v2", "--samples", "1"]
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


def train(folder, dataset, steps, evaluators):
    """One run on one thread; what was seen of it. Evaluations that are open when the last step is done are dropped."""
    run = Path(folder) / f"run-{time.time_ns()}"
    run.mkdir()
    command = [BIN / "learner", "train", *PRESET, "--dataset", dataset, "--run-dir", run]
    command += ["--steps", str(steps), "--listen", "tcp/127.0.0.1:0"]
    command += ["--eval-interval", str(EVAL_INTERVAL if evaluators else 0)]
    logs = [f"{run}.evaluator{i}.log" for i in range(evaluators)]
    seen = {"memory": [], "evaluator_memory": 0.0, "pages": []}
    with contextlib.ExitStack() as stack:
        learner = stack.enter_context(process(command, f"{run}.learner.log", CORES))
        while not (run / "endpoints.json").exists():
            if learner.poll() is not None:
                raise SystemExit(Path(f"{run}.learner.log").read_text())
            time.sleep(0.05)
        endpoints = json.loads((run / "endpoints.json").read_text())
        zenoh, metrics = endpoints["zenoh"][0], endpoints["metrics"]
        others = [
            stack.enter_context(process([BIN / "evaluator", "serve", "--connect", zenoh], log, CORES[1:]))
            for log in logs
        ]
        done = 0
        while learner.poll() is None and done < steps:
            time.sleep(0.5)
            with contextlib.suppress(OSError, TypeError):
                seen["memory"].append(resident(learner.pid))
                seen["evaluator_memory"] = max([seen["evaluator_memory"], *(resident(x.pid) for x in others)])
                page = urlopen(f"http://{metrics}/metrics", timeout=5).read().decode()
                done = metric(page, "quad_learner_gradient_steps_total")
                seen["pages"].append((time.time(), done, metric(page, "quad_learner_step_duration_seconds_sum")))
    taken = stamps(f"{run}.learner.log", "snapshot")
    seen["delays"], seen["begin"] = [], []
    for log in logs:
        arrived, begun = stamps(log, "weights arrived"), stamps(log, "evaluating")
        seen["delays"] += [arrived[step] - taken[step] for step in arrived if step in taken]
        seen["begin"] += [begun[step] - arrived[step] for step in begun if step in arrived]
    return seen


def pace(seen):
    """Seconds per gradient step, and the share of time outside the steps, from the second to the last look."""
    (start, first, before), (end, last, after) = seen["pages"][1], seen["pages"][-2]
    return (end - start) / (last - first), 1 - (after - before) / (end - start)


def start_up(folder, dataset):
    """Seconds of a whole process that makes one step."""
    begin = time.perf_counter()
    subprocess.run(
        [BIN / "learner", "train", *PRESET, "--dataset", dataset, "--steps", "1", "--eval-interval", "0"]
        + ["--run-dir", Path(folder) / f"start-{time.time_ns()}"],
        check=True,
        capture_output=True,
    )
    return time.perf_counter() - begin


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=600, help="of each of the four runs")
    parser.add_argument("--dataset", type=Path, default=Path("data/hopper-demo.hdf5"))
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        start = statistics.median(start_up(folder, arguments.dataset) for _ in range(5))
        alone, together = [], []
        for _ in range(2):
            alone.append(train(folder, arguments.dataset, arguments.steps, 0))
            together.append(train(folder, arguments.dataset, arguments.steps, EVALUATORS))
    a, b = (statistics.mean(pace(seen)[0] for seen in runs) for runs in (alone, together))
    outside = max(pace(seen)[1] for seen in together)
    delays = sorted(x for seen in together for x in seen["delays"])
    begin = sorted(x for seen in together for x in seen["begin"])
    memory = together[-1]["memory"]
    tenth = max(1, len(memory) // 10)
    rows = [
        ("learner, start to end of a process that makes one step", f"{start:.2f} s"),
        (
            "gradient step alone / with four evaluators",
            f"{1e3 * a:.2f} / {1e3 * b:.2f} ms ({100 * (b / a - 1):+.1f} %)",
        ),
        ("training thread's time outside the steps, with four evaluators", f"{100 * outside:.2f} %"),
        (
            f"snapshot taken → at an evaluator, {len(delays)} arrivals",
            f"median {1e3 * statistics.median(delays):.0f} ms, most {1e3 * delays[-1]:.0f} ms",
        ),
        (
            f"weights at an evaluator → its episodes begin, {len(begin)} times",
            f"median {1e3 * statistics.median(begin):.0f} ms, most {1e3 * begin[-1]:.0f} ms",
        ),
        (
            f"learner's memory, after a tenth / at the end of {arguments.steps} steps",
            f"{memory[tenth]:.0f} / {memory[-1]:.0f} MB",
        ),
        ("largest evaluator's memory", f"{max(seen['evaluator_memory'] for seen in together):.0f} MB"),
    ]
    print("| processes | |\n|---|---|")
    for name, value in rows:
        print(f"| {name} | {value} |")


if __name__ == "__main__":
    main()
