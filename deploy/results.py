#!/usr/bin/env python3
"""Prints the table of deploy/results.sh, as Markdown: python3 deploy/results.py RUN...

A run's number is the mean score of its snapshots in score.json; the table has their mean ± sample standard deviation over
the seeds, and how many these are where there are not three. Runs without a score.json are left out.
"""

import json
import statistics
import sys
from collections import defaultdict
from pathlib import Path


def spread(values):
    """Mean ± sample standard deviation; nothing of nothing."""
    if not values:
        return ""
    seeds = "" if len(values) == 3 else f" ({len(values)})"
    mean = f"{statistics.fmean(values):.1f}"
    return (f"{mean} ± {statistics.stdev(values):.1f}" if len(values) > 1 else mean) + seeds


def row(*cells):
    print("|", " | ".join(cells), "|")


def main(runs):
    scores = defaultdict(list)  # by method, candidates and file: a number for each seed
    files, settings = {}, set()
    for run in sorted(map(Path, runs)):
        if not (run / "score.json").exists():
            continue
        file, method, _ = run.parts[-3:]
        means = defaultdict(list)  # by candidates: a number for each snapshot
        for scored in json.loads((run / "score.json").read_text()):
            episodes = [episode["score"] for episode in scored["episodes"]]
            means[str(scored["choice"]["candidates"]) if scored["choice"] else "none"].append(statistics.fmean(episodes))
            settings.add(f"{len(episodes)} episodes each in {scored['precision']}")
        for candidates, of_snapshots in means.items():
            scores[method, candidates, file].append(statistics.fmean(of_snapshots))
        files[file] = f"{json.loads((run / 'report.json').read_text())['dataset_score']:.1f}"

    row("method", "candidates", *files)
    row(*["---"] * (2 + len(files)))
    row("its episodes", "", *files.values())
    for method, candidates in dict.fromkeys(key[:2] for key in scores):
        row(method, candidates, *(spread(scores[method, candidates, file]) for file in files))
    print("\nNormalized score: mean of a run's last snapshots,", " or ".join(sorted(settings)) + "; ± over the seeds.")


if __name__ == "__main__":
    main(sys.argv[1:])
