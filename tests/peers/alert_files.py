"""Checks that each alert says what to do, fires in a test, and asks for metrics that docs/metrics.md has.

    alert_files.py FOLDER      the repository
"""
import pathlib
import re
import sys

import yaml

folder = pathlib.Path(sys.argv[1])
rules, tests, metrics = (
    (folder / path).read_text() for path in ("deploy/prometheus/alerts.yml", "deploy/prometheus/alerts.test.yml", "docs/metrics.md")
)
alerts = [rule for group in yaml.safe_load(rules)["groups"] for rule in group["rules"]]
assert len(alerts) > 10
for alert in alerts:
    name, said = alert["alert"], alert["annotations"]
    assert said["summary"] and len(said["description"].split()) >= 15, f"{name} says too little of what to do"
    assert f'alertname="{name}"' in tests, f"{name} fires in no test"
for metric in set(re.findall(r"\bquad_\w+", rules)):
    assert re.search(f"`{metric}[`{{]", metrics), f"docs/metrics.md has no {metric}"
