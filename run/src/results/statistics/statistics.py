"""Writes statistics.json: scores that are made up, and what rliable and SciPy say of them. The tests of results/statistics.rs
compare with it.

    python3 -m venv /tmp/rliable && /tmp/rliable/bin/pip install rliable==1.2.0 "pandas<3"
    /tmp/rliable/bin/python run/src/results/statistics/statistics.py
"""

import json
import pathlib

import numpy as np
import scipy.stats
from rliable import library, metrics

RESAMPLES = 50_000
THRESHOLDS = [0.0, 20.0, 50.5, 75.0, 100.0]

random = np.random.default_rng(7)
# Runs x tasks; some runs have equal scores, and some are better than an expert.
scores = {
    "x": np.round(random.normal([30, 60, 80, 105], [3, 10, 5, 8], (5, 4)), 1),
    "y": np.round(random.normal([28, 66, 80, 99], [6, 8, 5, 2], (7, 4)), 1),
    "one task": np.round(random.normal(50, 9, (10, 1)), 1),
}
scores["y"][0] = scores["x"][0]


def aggregates(of):
    """In the order of the test's; scores count over 100, and all but the gap are given in the scores' own unit."""
    of = of / 100
    return np.array(
        [
            100 * metrics.aggregate_iqm(of),
            100 * metrics.aggregate_mean(of),
            100 * metrics.aggregate_median(of),
            metrics.aggregate_optimality_gap(of),
        ]
    )


def improvement(x, y):
    return np.array([metrics.probability_of_improvement(x, y)])


np.random.seed(0)
points, intervals = library.get_interval_estimates(scores, aggregates, reps=RESAMPLES)
pair = {"": [scores["x"], scores["y"]]}
_, of_improvement = library.get_interval_estimates(pair, improvement, reps=RESAMPLES // 10)
differences = [(scores["x"][:, task] - scores["y"][:5, task]).tolist() for task in range(2)]
tests = [
    scipy.stats.permutation_test((np.array(d),), np.mean, permutation_type="samples", n_resamples=np.inf).pvalue
    for d in [differences[0], differences[0] + differences[1]]
]
content = {
    "methods": {
        name: {
            "scores": of.T.tolist(),
            "values": points[name].tolist(),
            "low": intervals[name][0].tolist(),
            "high": intervals[name][1].tolist(),
            "profile": [library.run_score_deviation(of, threshold) for threshold in THRESHOLDS],
        }
        for name, of in scores.items()
    },
    "thresholds": THRESHOLDS,
    "improvement": [improvement(*pair[""])[0], *(float(end[0]) for end in of_improvement[""])],
    "differences": differences,
    "p_values": tests,
}
path = pathlib.Path(__file__).with_suffix(".json")
path.write_text(json.dumps(content, indent=1) + "\n")
