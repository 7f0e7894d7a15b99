#!/usr/bin/env python3
"""Draws the figures of docs/lambda.md: the paired differences of studies/lambda.toml, and what `evaluator probe` found.

    python3 deploy/lambda.py probes/*.json

A probe's output, `evaluator probe RUN --step N --json`, is named after its task and step: hopper-demo-20000.json. Needs matplotlib.
"""

import json
import re
import sys
from collections import defaultdict
from pathlib import Path
from statistics import fmean
from types import SimpleNamespace

import matplotlib
from matplotlib import pyplot
from study import Study, interval

HOME = Path(__file__).parent.parent
CHOICE = "best of 10"
PAIRS = [("quad", "shuffled"), ("quad", "mean"), ("quad", "dac"), ("dac", "none"), ("denoised", "dac")]
WEIGHTS = {
    "λ = 1": "DAC: λ = 1",
    "best constant": "best constant",
    "mean λ of each t": "mean λ of each t",
    "shuffled λ": "shuffled λ",
    "QUAD's λ": "QUAD's λ",
    "1, at the denoised estimate": "λ = 1, at the denoised estimate",
}
COUNTS = [2, 5, 10, 32]


def name(task):
    return {"half": "HalfCheetah", "hopp": "Hopper", "walk": "Walker2d", "antm": "umaze"}[task[:4]]


def save(figure, file):
    figure.savefig(HOME / "docs" / file, metadata={"Date": None})


def draw_pairs():
    """A dot for each pair of equal task and seed; a line for the mean's interval."""
    study = Study(SimpleNamespace(study=HOME / "studies/lambda.toml"))
    figure, axes = pyplot.subplots(figsize=(7, 2.8), layout="constrained")
    for row, (ours, theirs) in enumerate(PAIRS):
        ours, theirs = (study.of_method(method, CHOICE) for method in (ours, theirs))
        differences = {key: ours[key] - theirs[key] for key in ours if key in theirs}
        for color, task in enumerate(dict.fromkeys(task for task, _ in differences)):
            dots = [difference for (of, _), difference in differences.items() if of == task]
            label = name(task) if row == 0 else None
            axes.plot(dots, [row - 0.1 + 0.2 * color] * len(dots), "o", color=f"C{color}", alpha=0.7, label=label)
        if len(differences) > 1:
            axes.plot(interval(list(differences.values())), [row, row], color="black")
            axes.plot(fmean(differences.values()), row, "|", color="black", markersize=12)
    axes.axvline(0, color="gray", linewidth=0.8)
    axes.set_yticks(range(len(PAIRS)), [f"{ours} − {theirs}" for ours, theirs in PAIRS])
    axes.invert_yaxis()
    axes.set_xlabel("difference of normalized scores, best of ten")
    axes.legend()
    save(figure, "lambda-pairs.svg")


def draw(probes, file, title, label, rows, column):
    """A column of a probe's table: panels are tasks, groups steps, dots rows."""
    figure, panels = pyplot.subplots(1, len(probes), figsize=(9, 3.2), layout="constrained", squeeze=False)
    for axes, (task, steps) in zip(panels[0], probes.items()):
        for group, step in enumerate(sorted(steps)):
            table = next(table for table in steps[step] if table["title"].startswith(title))
            estimates = {row: numbers[table["columns"].index(column)] for row, numbers in table["rows"]}
            for place, (row, text) in enumerate(rows.items()):
                number = estimates[row]
                errors = [[number["value"] - number["low"]], [number["high"] - number["value"]]]
                x = group + 0.8 * (place / (len(rows) - 1) - 0.5)
                axes.errorbar(x, number["value"], errors, fmt="o", color=f"C{place}", label=text if group == 0 else None)
        axes.axhline(0, color="gray", linewidth=0.8)
        axes.set_xticks(range(len(steps)), [f"{step // 1000},000 steps" for step in sorted(steps)])
        axes.set_title(name(task))
    panels[0][0].set_ylabel(label)
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save(figure, file)


def main(files):
    matplotlib.rcParams["svg.hashsalt"] = "quad"  # the same file each time
    probes = defaultdict(dict)  # by task and step
    for file in map(Path, files):
        task, step = re.fullmatch(r"(.+)-([0-9]+)", file.stem).groups()
        probes[task][int(step)] = json.loads(file.read_text())
    draw_pairs()
    locomotion = {task: steps for task, steps in probes.items() if not task.startswith("antmaze")}
    draw(locomotion, "lambda-risk.svg", "Risk of weights", "risk (Eq. 14)", WEIGHTS, "risk")
    counts = {f"largest mean of {count}": f"best of {count}" for count in COUNTS}
    draw(probes, "lambda-choice.svg", "Choices", "true value above\nthe mean candidate", counts, "above the mean candidate")


if __name__ == "__main__":
    main(sys.argv[1:])
