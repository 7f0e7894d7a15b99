"""Policies as ONNX models, which run without this package: in C++, in ROS 2, on a robot."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from secrets import token_hex

from quad_rl._extras import library
from quad_rl._quad_rl import Policy


def export_onnx(
    policy: Policy | str | PathLike[str],
    path: str | PathLike[str],
    *,
    candidates: int | None = None,
    rule: str | None = None,
    aggregate: str | None = None,
    guidance: float | None = None,
) -> None:
    """Writes a policy, or that of a snapshot's file, as an ONNX model of opset 17, in float32.

    It acts as `Policy.act` does with the same `candidates`, `rule`, `aggregate` and `guidance`, which are fixed in the model. The
    number of states, n, is free.

    Inputs: `observations` [n, observation_size] and the arrays of `policy.noise(n, ...)`: `noise`, standard normal numbers, and
    `uniform`, numbers within [0, 1); 1 itself takes the best action. Draw them anew for each action.

    Outputs: `actions` [n, action_size], or [n, chunk, action_size] of a policy of chunks, whose `chunk` and `replan`, the
    number of actions to execute before the next run, are in the model's metadata; `values` [n, candidates], as of
    `Policy.sample`, if the policy has critics; and, for a planner that follows a plan for several steps, `plan`
    [n, steps, action_size], which begins with `actions`: run the model again after the last.

    Raises ImportError without the package onnx, ValueError for a choice that the policy cannot make, OSError if the file
    cannot be written.
    """
    library("onnx", "onnx")
    from quad_rl.onnx.export import model

    if not isinstance(policy, Policy):
        policy = Policy.load(policy)
    written = model(policy, candidates=candidates, rule=rule, aggregate=aggregate, guidance=guidance).SerializeToString()
    whole = Path(path)
    partial = whole.with_name(f"{whole.name}.{token_hex(4)}.partial")  # An existing file stays until the new one is complete.
    try:
        with open(partial, "xb") as file:
            file.write(written)
        partial.replace(whole)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
