#!/usr/bin/env python3
"""Prints the table of studies/online.toml, as Markdown: python3 deploy/online.py runs/online

For each dataset the score before online learning (mean of the last three evaluations), after it and on the dataset alone (of the last five),
mean ± sample standard deviation over the seeds, and how many these are where there are not three. Runs that are not complete are left out.
"""

import json
import re
import statistics
import sys
from collections import defaultdict
from pathlib import Path

from results import row, spread

COLUMNS = "before", "after", "alone"

if len(sys.argv) != 2:
    sys.exit(__doc__)
scores = defaultdict(list)  # by method, environment and column: a number for each seed
for file in sorted(Path(sys.argv[1]).glob("*/report.json")):
    environment, method = re.fullmatch(r"(\w+)-demo-\w+-(.+)-seed\d+", file.parent.name).groups()
    report = json.loads(file.read_text())
    if report["episodes_missing"]:
        continue
    before = [it["score"]["mean"] for it in report["evaluations"] if it.get("environment_steps") == 0]
    if before:
        scores[method, environment, "before"].append(statistics.fmean(before[-3:]))
    column = "alone" if method.endswith("-alone") else "after"
    scores[method.removesuffix("-alone"), environment, column].append(report["mean_last_5"])

if not scores:
    sys.exit(f"no run below {sys.argv[1]} is complete: `learner sweep studies/online.toml` trains them")
environments = sorted({environment for _, environment, _ in scores})
row("method", *(f"{environment}, {column}" for environment in environments for column in COLUMNS))
row(*["---"] * (1 + len(COLUMNS) * len(environments)))
for method in dict.fromkeys(method for method, *_ in scores):
    row(method, *(spread(scores[method, environment, column]) for environment in environments for column in COLUMNS))
