#!/usr/bin/env python3
"""Measures how reliable `learner judge` is: trains five algorithms on each file, judges them, and compares with true scores.

    python3 deploy/judged.py [--seeds 0 1 2] [--programs target/release] FILE...

A file's name begins with its environment, as for deploy/results.sh: hopper, halfcheetah, walker2d or antmaze_umaze. The runs are
the demonstration's, but hold out a tenth of the episodes; the true score of a policy is its mean over 100 episodes. Prints for each
file and seed how the judgment's order agrees with the true one (Spearman's rank correlation), and what is lost by taking the
judgment's first policy instead of the truly best. Runs go to runs/judged; what is done already is skipped.
"""

import argparse
import json
import os
import statistics
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

METHODS = {"bc": ["--agent", "guidance=none"]} | {name: ["--algorithm", name] for name in ("iql", "ivr", "xql", "dtql")}
TASKS = {"hopper": "hopper-demo", "half": "halfcheetah-demo", "walker": "walker2d-demo", "antmaze_umaze": "antmaze-umaze-demo"}
HOME = Path("runs/judged")


def call(*command, log):
    with log.open("w") as errors:
        one = os.environ | {"RAYON_NUM_THREADS": "1"}
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=one)
    if done.returncode:
        raise SystemExit(f"{command[0].name} ended with exit code {done.returncode}: {log} has its reason")
    return done.stdout


def train(programs, file, seed, method):
    """Trains one, and scores its last snapshot."""
    run = HOME / file.stem / str(seed) / method
    score = run.with_suffix(".score.json")
    if score.exists():
        return
    run.parent.mkdir(parents=True, exist_ok=True)
    task = next(task for start, task in TASKS.items() if file.name.startswith(start))
    flags = ["--seed", str(seed), "--eval-interval", "0", "--hold-out", "0.1", "--http", "127.0.0.1:0", *METHODS[method]]
    log = run.with_suffix(".log")
    call(programs / "learner", "train", "--task", task, "--dataset", file, "--run-dir", run, *flags, log=log)
    snapshot = max((run / "snapshots").iterdir())
    score.write_text(call(programs / "evaluator", "score", "--json", "--episodes", "100", snapshot, log=log))


def judge(programs, file, seed):
    """Judges all of a file and seed; gives the ranking and each policy's true score."""
    home = HOME / file.stem / str(seed)
    ranking = json.loads(call(programs / "learner", "judge", "--json", home, log=home / "judge.log"))
    true = {}
    for policy in ranking["policies"]:
        (scored,) = json.loads((home / f"{Path(policy['run']).name}.score.json").read_text())
        true[policy["run"]] = statistics.fmean(episode["score"] for episode in scored["episodes"])
    return ranking, true


def ranks(values):
    return [sorted(values).index(value) for value in values]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--programs", type=Path, default=Path("target/release"))
    given = parser.parse_args()
    for file in given.files:
        if not file.name.startswith((*TASKS,)):
            parser.error(f"the name of {file} does not begin with an environment")
    jobs = [(given.programs, file, seed, method) for seed in given.seeds for file in given.files for method in METHODS]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(lambda job: train(*job), jobs))
    print("| file | seed | rank correlation | best | judged best | lost | doubtful | behavior off | range | ranks |")
    print("|---|---:|---:|---:|---|---:|---:|---:|---:|---|")
    for file in given.files:
        for seed in given.seeds:
            ranking, true = judge(given.programs, file, seed)
            sure = [policy for policy in ranking["policies"] if not policy["estimate"]["doubts"]]
            values = [statistics.fmean(policy["estimate"]["values"]) for policy in sure]
            scores = [true[policy["run"]] for policy in sure]
            agreement = f"{statistics.correlation(ranks(values), ranks(scores)):.2f}" if len(sure) > 1 else "-"
            best = max(true.values())
            first = f"{Path(sure[0]['run']).name} {scores[0]:.1f} | {best - scores[0]:.1f}" if sure else "- | -"
            off = abs(statistics.fmean(ranking["behavior"]["values"]) - ranking["recorded"])
            extent = f"{max(values) - min(values):.2f}" if sure else "-"
            doubtful = len(true) - len(sure)
            can = "yes" if ranking["can_rank"] else "no"
            print(f"| {file.stem} | {seed} | {agreement} | {best:.1f} | {first} | {doubtful} | {off:.2f} | {extent} | {can} |")


if __name__ == "__main__":
    main()
