#!/usr/bin/env python3
"""Prints the table of deploy/results.sh, as Markdown: python3 deploy/results.py RUN...

A run's number is the mean score of its snapshots in score.json; the table has their mean ± sample standard deviation over
the seeds. Runs without a score.json are left out.
"""

import json
import statistics
import sys
from collections import defaultdict
from pathlib import Path

# Title, guidance and number of candidates.
COLUMNS = [
    ("BC, 1", "none", 1),
    ("BC, best of 10", "none", 10),
    ("DAC, 1", "dac", 1),
    ("DAC, best of 10", "dac", 10),
    ("QUAD, 1", "quad", 1),
    ("QUAD, best of 10", "quad", 10),
]


def spread(values):
    """Mean ± sample standard deviation; nothing of nothing."""
    if not values:
        return ""
    mean = f"{statistics.fmean(values):.1f}"
    return f"{mean} ± {statistics.stdev(values):.1f}" if len(values) > 1 else mean


def row(*cells):
    print("|", " | ".join(cells), "|")


def main(runs):
    scores = defaultdict(list)  # by file, guidance and candidates: a number for each seed
    files = {}
    settings = set()
    for run in map(Path, runs):
        if not (run / "score.json").exists():
            continue
        file, guidance, _ = run.name.rsplit("-", 2)
        means = defaultdict(list)  # by candidates: a number for each snapshot
        for scored in json.loads((run / "score.json").read_text()):
            episodes = [episode["score"] for episode in scored["episodes"]]
            means[scored["choice"]["candidates"]].append(statistics.fmean(episodes))
            settings.add(f"{len(episodes)} episodes each in {scored['precision']}")
        for candidates, of_snapshots in means.items():
            scores[file, guidance, candidates].append(statistics.fmean(of_snapshots))
        report = json.loads((run / "report.json").read_text())
        files[file] = (f"{report['dataset_score']:.1f}", f"{report['steps']:,}")

    row("file", "its episodes", "steps", *(title for title, *_ in COLUMNS), "seeds")
    row(*["---"] * (4 + len(COLUMNS)))
    for file, about in sorted(files.items()):
        numbers = [scores[file, guidance, candidates] for _, guidance, candidates in COLUMNS]
        row(file, *about, *map(spread, numbers), str(max(map(len, numbers))))
    print("\nNormalised score: mean of a run's last snapshots,", " or ".join(sorted(settings)) + "; ± over the seeds.")


main(sys.argv[1:])
