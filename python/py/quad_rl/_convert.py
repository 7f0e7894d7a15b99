"""`quad-convert`: other programs' data as a file that `learner train --dataset` takes."""

from __future__ import annotations

import argparse
import inspect
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from quad_rl._dataset import Dataset

_WORDS = {
    "action": "LeRobot: the feature that is done (action)",
    "reward": "success-at-end, step-cost, or a column",
    "terminate": "LeRobot, robomimic: success, never, or a column",
    "terminal": "tables: success, never, or a column",
    "episode": "tables: the column that is the same in all rows of an episode",
    "apart": "tables: what rows of an episode are that do not lie together, interleaved or repeated",
    "task": "LeRobot: the only task to be read, or all",
    "filter": "robomimic: a filter key such as train",
    "folder": "OGBench: where its files are (~/.ogbench/data)",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command, and gives its exit status."""
    parser = argparse.ArgumentParser(
        prog="quad-convert",
        description="Makes a file for `learner train --dataset` of LeRobot, robomimic, Minari, OGBench, CSV or Parquet.",
        epilog="help(quad_rl.Dataset.from_lerobot) and its siblings say what each word means. Python also takes functions.",
    )
    parser.add_argument("source", help="a folder of LeRobot or Minari, a file of robomimic, a table, minari:ID, ogbench:NAME")
    parser.add_argument("--out", required=True, metavar="FILE", help="the file to write, such as my-robot.hdf5")
    parser.add_argument("--observations", nargs="+", metavar="COLUMN", help="what is seen, in this order")
    parser.add_argument("--actions", nargs="+", metavar="COLUMN", help="what is done (tables, robomimic)")
    parser.add_argument("--success", nargs="+", help="all, a column, or the successful episodes' numbers or names")
    parser.add_argument("--continuous", action="store_true", default=None, help="whole numbers are actions, too: amounts, no choices")
    for name, text in _WORDS.items():
        parser.add_argument(f"--{name}", help=text)
    given = {name: value for name, value in vars(parser.parse_args(arguments)).items() if value is not None}
    source, out = given.pop("source"), given.pop("out")
    try:
        dataset = _read(source, given)
        dataset.save(out)
    except (ValueError, ImportError, OSError) as error:
        print(f"quad-convert: {error}", file=sys.stderr)
        return 1
    except Exception as error:  # A source's own library raises what it will, such as httpx's where there is no network.
        print(f"quad-convert: {source} cannot be read: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    _print(f"{dataset}\n\nwritten to {out}: learner train --task own-data --env my-robot --dataset {out} --scale actions,states")
    return 0


def _print(text: str) -> None:
    try:
        print(text, flush=True)
    except BrokenPipeError:  # A reader that stops early, such as `head`. Python would complain at its end, too.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def _read(source: str, given: dict[str, Any]) -> Dataset:
    read, place = _reader(source)
    if "success" in given:
        given["success"] = _success(given["success"])
    known = inspect.signature(read).parameters
    for name in given.keys() - known.keys():
        words = ", ".join(f"--{name}" for name in [*known][1:])
        raise ValueError(f"--{name} says nothing of this source; {words or 'nothing'} does")
    missing = [name for name, parameter in known.items() if parameter.kind is parameter.KEYWORD_ONLY
               and parameter.default is parameter.empty and name not in given]
    if missing:
        raise ValueError(f"{source} needs {' and '.join('--' + name for name in missing)}\nhint: quad-convert --help")
    return read(place, **given)


def _reader(source: str) -> tuple[Callable[..., Dataset], str]:
    """The function that reads a source, and what it calls it."""
    scheme, _, name = source.partition(":")
    if scheme in ("minari", "ogbench"):
        return (Dataset.from_minari if scheme == "minari" else Dataset.from_ogbench), name
    path = Path(source)
    if not path.exists():
        raise ValueError(f"there is no {source}")
    if path.is_dir():
        return (Dataset.from_lerobot if (path / "meta/info.json").is_file() else Dataset.from_minari), source
    with path.open("rb") as file:
        is_hdf5 = file.read(8) == b"\x89HDF\r\n\x1a\n"
    return (Dataset.from_robomimic if is_hdf5 else Dataset.from_frame), source


def _success(words: list[str]) -> Any:
    listed = [int(word) if word.isdigit() else word for word in words]
    return words[0] if listed == words[:1] else listed
