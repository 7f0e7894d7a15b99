"""Policies as folders for LeRobot and its plugin in python/lerobot_policy_quad."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quad_rl._quad_rl import Policy

# `images` and `states` are the beginnings of several features, such as `observation.states.joint_state`.
_FEATURE = re.compile(r"observation\.((images|states)\.)?[^.\[]+")
# LeRobot's programs set values of steps by these names. Nothing is normalized, as the policy itself scales.
_DEVICE = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
_RENAME = {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}}
_BATCH = {"registry_name": "to_batch_processor", "config": {}}
_STEPS = {"policy_preprocessor": [_RENAME, _BATCH, _DEVICE], "policy_postprocessor": [_DEVICE]}
_CARD = """---
library_name: lerobot
pipeline_tag: robotics
tags: [robotics, lerobot, quad]
---

# {policy}

A policy of QUAD, for LeRobot with the plugin `lerobot_policy_quad`. It sees {seen}, in the units of its data:

```json
{about}
```
"""


def inputs(policy: Policy, features: Iterable[str] = ()) -> dict[str, list[int]]:
    """The features of LeRobot's that a policy sees, with the places of their numbers in an observation.

    features: those of the robot, if they are known. Where names are others than `Dataset.from_lerobot` gives, or none, all are
        the robot's state.
    """
    longest_first = sorted((name for name in features if name.startswith("observation.")), key=len, reverse=True)
    sources = []
    for column in policy.observation_names:
        match = _FEATURE.match(column)
        feature = next((name for name in longest_first if column == name or column.startswith((f"{name}.", f"{name}["))), None)
        sources += [feature] if feature else [match.group()] if match else []
    if len(sources) < policy.observation_size:
        sources = ["observation.state"] * policy.observation_size
    return {name: [place for place, other in enumerate(sources) if other == name] for name in dict.fromkeys(sources)}


def places(wanted: list[str], there: list[str]) -> list[int]:
    """Where each wanted column is among those that are there. Names that several columns have say nothing of their places."""
    if wanted == there:
        return [*range(len(there))]
    missing = [name for name in wanted if name not in there]
    if missing:
        raise ValueError(f"there is no column {', '.join(missing)}\nhint: there are {', '.join(there)}")
    for name in [name for name in there if name in wanted and max(there.count(name), wanted.count(name)) > 1]:
        hint = "hint: give each its own name in the robot's features, in the policy's data, or in the same order in both"
        raise ValueError(f"there are several columns {name}, which cannot be told apart\n{hint}")
    return [there.index(name) for name in wanted]


def act(episodes: Any, rows: NDArray[np.float32], seen: list[int], done: list[int]) -> NDArray[np.float32]:
    """Actions of `Policy.begin`'s episodes in the robot's order: number i of an action is the policy's number `done[i]`, and number
    i of the policy's observation is number `seen[i]` of a row."""
    actions: NDArray[np.float32] = episodes.act(rows[:, seen])[:, done]
    return actions


def export_lerobot(policy: Policy | str | PathLike[str], folder: str | PathLike[str]) -> None:
    """Writes a policy, or that of a snapshot's file, as a folder for LeRobot's `--policy.path`: config.json, model.safetensors,
    the processors and a card, README.md. LeRobot needs the plugin lerobot_policy_quad. Raises OSError if it cannot be written.
    """
    if not isinstance(policy, Policy):
        policy = Policy.load(policy)
    seen = {}
    for name, places in inputs(policy).items():
        kind = "VISUAL" if "image" in name else "ENV" if name == "observation.environment_state" else "STATE"
        seen[name] = {"type": kind, "shape": [3, -1, -1] if kind == "VISUAL" else [len(places)]}  # Images of any size.
    done = {"action": {"type": "ACTION", "shape": [policy.action_size]}}
    config = {"type": "quad", "device": "cpu", "input_features": seen, "output_features": done}
    root = Path(folder)
    root.mkdir(parents=True, exist_ok=True)
    (root / "model.safetensors").write_bytes(policy.to_bytes())
    for name, steps in _STEPS.items():
        (root / f"{name}.json").write_text(json.dumps({"name": name, "steps": steps}, indent=2))
    card = _CARD.format(policy=policy, seen=", ".join(f"`{name}`" for name in seen), about=json.dumps(policy.about, indent=2))
    (root / "README.md").write_text(card, encoding="utf-8")
    (root / "config.json").write_text(json.dumps(config, indent=2))
