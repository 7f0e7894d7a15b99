"""`quad-convert`: other programs' data as a file that `learner train --dataset` takes, or trained on at once."""

from __future__ import annotations

import argparse
import inspect
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from quad_rl import _quad_rl
from quad_rl._dataset import Dataset
from quad_rl._train import learner
from quad_rl.readers.frame import TABLES

_OPTIONS = {
    "action": "LeRobot: the feature with the actions (action)",
    "reward": "success-at-end, step-cost, a column, or none, for data to clone",
    "terminate": "LeRobot, robomimic: success, never, or a column",
    "terminal": "tables: success, never, or a column",
    "episode": "tables: the column that is the same in all rows of an episode; file, for a folder of tables",
    "apart": "tables: how an episode's rows may be apart, interleaved or repeated",
    "task": "LeRobot: the only task to read, or all",
    "filter": "robomimic: a filter key such as train",
    "folder": "OGBench: the folder of its files (~/.ogbench/data)",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command and returns its exit status."""
    parser = argparse.ArgumentParser(
        prog="quad-convert",
        description="Converts LeRobot, robomimic, Minari, OGBench, CSV or Parquet to a file for `learner train --dataset`.",
        epilog="help(quad_rl.Dataset.from_lerobot) and its siblings explain each option. From Python, some may be functions.",
    )
    parser.add_argument("source", help="a folder of LeRobot or Minari, a file of robomimic, a table or a folder of them, minari:ID, ogbench:NAME")
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write, such as my-robot.hdf5")
    parser.add_argument("--observations", nargs="+", metavar="COLUMN", help="observations, in this order; tables: also 'q*'")
    parser.add_argument("--actions", nargs="+", metavar="COLUMN", help="actions (tables, robomimic)")
    parser.add_argument("--success", nargs="+", help="all, a column, or the successful episodes' numbers or names")
    parser.add_argument("--continuous", action="store_true", default=None, help="integer actions are continuous: amounts, not choices")
    for name, text in _OPTIONS.items():
        parser.add_argument(f"--{name}", help=text)
    parser.add_argument("--train", nargs=argparse.REMAINDER, help="then run learner train with all that follows")
    given = {name: value for name, value in vars(parser.parse_args(arguments)).items() if value is not None}
    source, out, training = given.pop("source"), given.pop("out"), given.pop("train", None)
    try:
        program = None if training is None else learner()
        if os.path.exists(source) and os.path.exists(out) and os.path.samefile(source, out):
            raise ValueError(f"{out} is the source itself, which the new file would replace\nhint: name another file by --out")
        dataset = _read(source, given)
        dataset.save(out)
    except (ValueError, ImportError, OSError, RuntimeError) as error:
        print(f"quad-convert: {error}", file=sys.stderr)
        return 1
    except Exception as error:  # A source's library may raise anything, such as httpx's errors without a network.
        print(f"quad-convert: {source} cannot be read: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    command = ["learner", "train", "--dataset", out, *_training(training or [], given.get("reward"))]
    _print(f"{dataset}\n\nwritten to {out}: {shlex.join(command)}")
    if program is not None:
        os.execv(program, command)  # Ctrl-C and the exit status are the learner's.
    return 0


def _training(given: list[str], reward: str | None) -> list[str]:
    """These arguments of `learner train`, and the usual ones of other names."""
    usual = {"--task": "own-data", "--normalize": "actions,observations"}
    if reward == "none":
        usual["--algorithm"] = "diffusion-policy"
    named = {word.partition("=")[0] for word in given}
    return [*(word for pair in usual.items() if pair[0] not in named for word in pair), *given]


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:  # The reader stopped early, such as `head`. At exit, Python would complain again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _read(source: str, given: dict[str, Any]) -> Dataset:
    read, place = _reader(source)
    if len(given.get("success", ())) == 1:
        given["success"] = given["success"][0]
    parameters = inspect.signature(read).parameters
    for name in given.keys() - parameters.keys():
        options = ", ".join(f"--{name}" for name in [*parameters][1:] if name != "features")  # Functions are Python's.
        raise ValueError(f"--{name} does not apply to this source; its options: {options or 'none'}")
    missing = [name for name, parameter in parameters.items() if parameter.kind is parameter.KEYWORD_ONLY
               and parameter.default is parameter.empty and name not in given]
    if missing:
        raise ValueError(f"{source} needs {' and '.join('--' + name for name in missing)}\nhint: quad-convert --help")
    return read(place, **given)


def _reader(source: str) -> tuple[Callable[..., Dataset], str]:
    """The function that reads a source, and its argument."""
    scheme, _, name = source.partition(":")
    if scheme in ("minari", "ogbench"):
        return (Dataset.from_minari if scheme == "minari" else Dataset.from_ogbench), name
    path = Path(source)
    if not path.exists():
        raise ValueError(f"there is no {source}")
    if path.is_dir():
        if (path / "meta/info.json").is_file():
            return Dataset.from_lerobot, source
        if any((path / name).is_file() for name in ("metadata.json", "data/metadata.json")):
            return Dataset.from_minari, source
        if any(file.suffix.lower() in TABLES for file in path.iterdir()):
            return Dataset.from_frame, source
    else:
        with path.open("rb") as file:
            start = file.read(256)
        if start.startswith(b"\x89HDF\r\n\x1a\n"):
            return Dataset.from_robomimic, source
        if start.startswith((b"PAR1", b"\xff\xfe")) or b"\0" not in start:  # The second begins UTF-16, whose error has a hint.
            return Dataset.from_frame, source
    _quad_rl.inspect_dataset(path)  # Its error names other formats.
    raise ValueError(f"`learner train --dataset {source}` reads it as it is")
