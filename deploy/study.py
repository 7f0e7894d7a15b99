#!/usr/bin/env python3
"""Trains the runs of a study, scores their last five snapshots, and compares its methods in pairs of equal task and seed.

    python3 deploy/study.py studies/lambda.toml [--jobs 2]

For methods that draw candidates. Scores of finished runs go to one file beside the study, lambda.scores.json.gz. Runs in that
file are not trained again, so the same command continues after an interruption, and on another machine that has the file.
`--table` trains nothing.
"""

import argparse
import gzip
import itertools
import json
import os
import random
import re
import statistics
import subprocess
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock

SNAPSHOTS = 5
# One thread a run: as many runs at a time as cores are faster than one run on all.
ENVIRONMENT = os.environ | {"RAYON_NUM_THREADS": "1"}


def last_mean(metrics, name):
    """The mean of a metric without the first tenth of a run; none if it is absent."""
    values = [row[name] for row in metrics[len(metrics) // 10 :] if name in row]
    return statistics.fmean(values) if values else None


class Study:
    def __init__(self, given):
        self.given, self.lock = given, Lock()
        self.scores_file = given.study.with_suffix(".scores.json.gz")
        self.axes = tomllib.loads(given.study.read_text())["axes"]
        self.home = Path("runs") / given.study.stem
        self.scores = {}
        if self.scores_file.exists():
            self.scores = json.loads(gzip.decompress(self.scores_file.read_bytes()))

    def runs(self):
        """Name of each run, in the order of its number."""
        listed = self.call("learner", "sweep", self.given.study, "--list").splitlines()[1:]
        return [line.split()[1] for line in listed]

    def call(self, program, *arguments):
        command = [self.given.programs / program, *arguments]
        return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=ENVIRONMENT).stdout

    def train(self, index, name):
        """Trains and scores one run, and adds it to the file."""
        self.call("learner", "sweep", self.given.study, "--index", str(index), "--jobs", "1", "--evaluators", "1")
        run = self.home / name
        snapshots = sorted((run / "snapshots").iterdir())[-SNAPSHOTS:]
        scores = {}  # by choice: for each snapshot the scores of its episodes
        for strength in self.given.guidance:
            options = ["--episodes", str(self.given.episodes), "--candidates", self.given.candidates, "--guidance", str(strength)]
            for scored in json.loads(self.call("evaluator", "score", "--json", *options, *snapshots)):
                of_snapshots = scores.setdefault(choice(scored["choice"]["candidates"], strength), [])
                of_snapshots.append([round(episode["score"], 3) for episode in scored["episodes"]])
        metrics = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        with self.lock:
            self.scores[name] = {"scores": scores, "lambda": last_mean(metrics, "lambda_mean")}
            partial = self.scores_file.with_suffix(".partial")
            partial.write_bytes(gzip.compress(json.dumps(self.scores).encode(), mtime=0))
            partial.replace(self.scores_file)

    def of_method(self, method, choice):
        """The score of each run of a method, by task and dataset, and by seed: the mean over its snapshots' episodes."""
        name = re.compile(f"(.+)-{re.escape(method)}-seed([0-9]+)")
        scored = ((name.fullmatch(run), values["scores"].get(choice)) for run, values in self.scores.items())
        return {
            found.groups(): statistics.fmean(map(statistics.fmean, scores)) for found, scores in scored if found and scores
        }

    def print_scores(self, choices):
        print("| task | method | mean λ |", " | ".join(choices), "|")
        print("|---|---|---:|" + "---:|" * len(choices))
        for method in self.axes["method"]:
            columns = [self.of_method(method, choice) for choice in choices]
            for task in dict.fromkeys(task for task, _ in columns[0]):
                keys = [key for key in columns[0] if key[0] == task]
                weights = [self.scores[f"{task}-{method}-seed{seed}"]["lambda"] for _, seed in keys]
                weight = "" if None in weights else f"{statistics.fmean(weights):.2f}"
                cells = (spread([column[key] for key in keys if key in column]) for column in columns)
                print(f"| {task} | {method} | {weight} |", " | ".join(cells), "|")

    def print_pairs(self, choices):
        print("\n| choice | methods | pairs | mean difference | 95 % interval | p |\n|---|---|---:|---:|---|---:|")
        for choice, pair in itertools.product(choices, self.given.pairs):
            ours, theirs = (self.of_method(method, choice) for method in pair.split(":"))
            differences = [ours[key] - theirs[key] for key in ours if key in theirs]
            if len(differences) > 1:
                mean, (low, high) = statistics.fmean(differences), interval(differences)
                cells = f"{len(differences)} | {mean:.2f} | [{low:.2f}, {high:.2f}] | {sign_flips(differences):.4f}"
                print(f"| {choice} | {pair.replace(':', ' − ')} | {cells} |")


def choice(candidates, strength):
    """The best of several candidates, which guidance of some strength has drawn."""
    return f"best of {candidates}" + (f", guided by {strength:g}" if strength else "")


def spread(values):
    """Mean ± sample standard deviation, and how many values."""
    if not values:
        return ""
    deviation = f" ± {statistics.stdev(values):.1f}" if len(values) > 1 else ""
    return f"{statistics.fmean(values):.1f}{deviation} ({len(values)})"


def sign_flips(differences):
    """Two-sided p of the exact sign-flip test: how often random signs give a mean as far from 0."""
    observed = abs(sum(differences)) - 1e-9
    signs = itertools.product((-1, 1), repeat=len(differences))
    means = [abs(sum(map(lambda s, d: s * d, sign, differences))) >= observed for sign in signs]
    return sum(means) / len(means)


def interval(differences, draws=10_000):
    """The 95 % percentile interval of the mean, by the bootstrap from a fixed seed."""
    source = random.Random(0)
    means = sorted(statistics.fmean(source.choices(differences, k=len(differences))) for _ in range(draws))
    return means[draws // 40], means[-draws // 40 - 1]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at a time")
    parser.add_argument("--episodes", type=int, default=40, help="of each snapshot")
    parser.add_argument("--candidates", default="1,2,5,10")
    parser.add_argument("--guidance", nargs="+", type=float, default=[0.0, 0.3], metavar="W", help="strengths when acting")
    parser.add_argument("--pairs", nargs="+", default=["quad:dac"], metavar="METHOD:METHOD")
    parser.add_argument("--programs", type=Path, default=Path("target/release"))
    parser.add_argument("--table", action="store_true", help="print the tables of what is there")
    given = parser.parse_args()
    study = Study(given)
    if not given.table:
        left = [(index, name) for index, name in enumerate(study.runs()) if name not in study.scores]
        with ThreadPoolExecutor(given.jobs) as pool:
            list(pool.map(lambda run: study.train(*run), left))
    choices = [choice(n, strength) for strength, n in itertools.product(given.guidance, given.candidates.split(","))]
    study.print_scores(choices)
    study.print_pairs(choices)


if __name__ == "__main__":
    main()
