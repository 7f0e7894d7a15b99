#!/usr/bin/env python3
"""Draws the figures of docs/lambda.md.

    python3 deploy/lambda.py [FILE...]

The scores of studies/lambda.toml make one figure. Outputs of `examples/probe.py gradients --json`, named after task and step
(hopper-demo-20000.json), make the second, of `evaluator score --json`, named after task and rule (hopper-demo-min.json), the
third. Needs matplotlib.
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
CHOICES = {"best of 10": "best of ten", "best of 1": "one sample"}
METHODS = {"none": "cloning", "dac": "DAC", "quad": "QUAD", "mean": "mean λ", "shuffled": "shuffled λ", "denoised": "denoised"}
PAIRS = [("quad", "shuffled"), ("quad", "mean"), ("quad", "dac"), ("dac", "none"), ("denoised", "dac")]
WEIGHTS = {
    "λ = 1": "λ = 1 (DAC)",
    "best constant": "the best constant",
    "mean λ of each t": "mean λ of each t",
    "shuffled λ": "shuffled λ",
    "1, at the denoised estimate": "λ = 1, at the denoised estimate",
}
RULES = {"mean": "critics' mean", "min": "their minimum", "mean-minus-std-1": "mean − std", "mean-minus-std-3": "mean − 3 std"}
TASKS = {"hopper": "Hopper", "halfcheetah": "HalfCheetah", "walker2d": "Walker2d", "antmaze": "umaze"}


def name(task):
    return TASKS[task.split("-")[0]]


def in_order(tasks):
    return dict(sorted(tasks.items(), key=lambda of: list(TASKS.values()).index(name(of[0]))))


def save(figure, file):
    figure.savefig(HOME / "docs" / file, metadata={"Date": None})


def draw_pairs():
    """The scores of all runs; then a dot for each pair of equal task and seed, and a line for the mean's interval."""
    study = Study(SimpleNamespace(study=HOME / "studies/lambda.toml"))
    figure, (scores, *panels) = pyplot.subplots(1, 1 + len(CHOICES), figsize=(11, 3), layout="constrained")
    for row, method in enumerate(METHODS):
        draw_dots(scores, row, study.of_method(method, "best of 10"))
    rows(scores, METHODS.values(), "score, best of ten")
    figure.legend(*scores.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    for axes, (choice, text) in zip(panels, CHOICES.items()):
        for row, methods in enumerate(PAIRS):
            ours, theirs = (study.of_method(method, choice) for method in methods)
            differences = {key: ours[key] - theirs[key] for key in ours if key in theirs}
            draw_dots(axes, row, differences)
            axes.plot(interval(list(differences.values())), [row, row], color="black")
            axes.plot(fmean(differences.values()), row, "|", color="black", markersize=12)
        axes.axvline(0, color="gray", linewidth=0.8)
        rows(axes, [" − ".join(METHODS[method] for method in pair) for pair in PAIRS], f"difference, {text}")
    panels[1].set_yticklabels([])
    save(figure, "lambda-pairs.svg")


def draw_dots(axes, row, values):
    """A dot for each value, those of a task below those of the other."""
    for color, task in enumerate(("hopper", "walker2d")):
        dots = [value for (of, _), value in values.items() if of.startswith(task)]
        label = TASKS[task] if row == 0 else None
        axes.plot(dots, [row - 0.1 + 0.2 * color] * len(dots), "o", color=f"C{color}", alpha=0.7, label=label)


def rows(axes, names, text):
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel(text)


def draw_risks(probes):
    """Risks of weights less that of QUAD's λ: panels are tasks, groups steps."""
    figure, panels = pyplot.subplots(1, len(probes), figsize=(9, 3.2), layout="constrained", squeeze=False)
    for axes, (task, steps) in zip(panels[0], probes.items()):
        for group, step in enumerate(sorted(steps)):
            table = next(table for table in steps[step] if table["title"].startswith("Risk of weights"))
            numbers = {row: row_numbers[table["columns"].index("above QUAD's λ")] for row, row_numbers in table["rows"]}
            for place, (row, text) in enumerate(WEIGHTS.items()):
                value, low, high = (numbers[row][key] for key in ("value", "low", "high"))
                x = group + 0.15 * (place - len(WEIGHTS) // 2)
                label = text if group == 0 else None
                axes.errorbar(x, value, [[value - low], [high - value]], fmt="o", color=f"C{place}", label=label)
        axes.axhline(0, color="gray", linewidth=0.8)
        axes.set_yscale("symlog", linthresh=0.2)
        axes.set_xticks(range(len(steps)), [f"{step // 1000},000 steps" for step in sorted(steps)])
        axes.set_title(name(task))
    panels[0][0].set_ylabel("risk above QUAD's λ (Eq. 14)")
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    save(figure, "lambda-risk.svg")


def draw_choices(scores):
    """Mean scores over the number of candidates: panels are tasks, lines rules."""
    figure, panels = pyplot.subplots(1, len(scores), figsize=(9, 3), layout="constrained", squeeze=False)
    for axes, (task, rules) in zip(panels[0], scores.items()):
        for rule in (rule for rule in RULES if rule in rules):
            by_count = defaultdict(list)
            for snapshot in rules[rule]:
                by_count[snapshot["choice"]["candidates"]] += [episode["score"] for episode in snapshot["episodes"]]
            counts = sorted(by_count)
            axes.plot(range(len(counts)), [fmean(by_count[count]) for count in counts], "o-", label=RULES[rule])
            axes.set_xticks(range(len(counts)), counts)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("candidates")
        axes.set_title(name(task))
    panels[0][0].set_ylabel("score")
    panels[0][0].legend()
    save(figure, "lambda-choice.svg")


def main(files):
    matplotlib.rcParams["svg.hashsalt"] = "quad"  # the same file each time
    matplotlib.rcParams["svg.fonttype"] = "none"  # text as text, not as outlines
    probes, scores = defaultdict(dict), defaultdict(dict)
    for file in map(Path, files):
        task, what = re.fullmatch(r"(.+-demo)-(.+)", file.stem).groups()
        if what.isdigit():
            probes[task][int(what)] = json.loads(file.read_text())
        else:
            scores[task][what] = json.loads(file.read_text())
    draw_pairs()
    if probes:
        draw_risks(in_order(probes))
    if scores:
        draw_choices(in_order(scores))


if __name__ == "__main__":
    main(sys.argv[1:])
