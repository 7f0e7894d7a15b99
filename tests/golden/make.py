"""Golden numbers: one update of an algorithm, written a second time with JAX in float64.

    make.py --seed N --out DIR [--variant quad|dac|…|iql] [--size narrow|small|hopper]
    make.py --all      rewrites the committed folders, which stand beside this file
    make.py --check    checks that the committed folders are what it makes now

Writes folders as README.md beside this file describes them. Nothing here is taken from the Rust side: it is written from
the papers and that page.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save_file

import align_iql
import cql
import diffuser
import dql
import dtql
import fqe
import fql
import iql
import ivr
import onestep
import quad
import sfbc
import td3bc
import xql

HERE = Path(__file__).parent

# The committed folders: seed, variant, size.
FOLDERS = {
    "quad": (1, "quad", "small"),
    "dac": (2, "dac", "small"),
    "maxq": (3, "maxq", "small"),
    "none": (4, "none", "narrow"),
    "one-sample": (5, "one-sample", "narrow"),
    "ten-critics": (6, "ten-critics", "narrow"),
    "constant": (24, "constant", "small"),
    "mean": (25, "mean", "small"),
    "shuffled": (26, "shuffled", "small"),
    "iql": (13, "iql", "small"),
    "sql": (14, "sql", "small"),
    "eql": (15, "eql", "small"),
    "xql": (16, "xql", "small"),
    "xql-extras": (17, "xql-extras", "small"),
    "dql": (18, "dql", "small"),
    "dql-max-backup": (19, "dql-max-backup", "small"),
    "align-iql": (20, "align-iql", "small"),
    "idql": (53, "idql", "small"),
    "onestep-behavior": (21, "onestep-behavior", "small"),
    "onestep-critic": (22, "onestep-critic", "small"),
    "onestep-policy": (23, "onestep-policy", "small"),
    "cql": (27, "cql", "small"),
    "cql-lagrange": (28, "cql-lagrange", "small"),
    "cql-cloning": (29, "cql-cloning", "small"),
    "dtql-pretraining": (27, "dtql-pretraining", "small"),
    "dtql": (28, "dtql", "small"),
    "dtql-likelihood": (29, "dtql-likelihood", "small"),
    "sfbc-behavior": (40, "sfbc-behavior", "small"),
    "sfbc-critic": (41, "sfbc-critic", "small"),
    "sfbc-planning": (42, "sfbc-planning", "small"),
    "diffuser": (40, "diffuser", "small"),
    "diffuser-attention": (41, "diffuser-attention", "small"),
    "fqe": (50, "fqe", "small"),
    "td3-bc": (51, "td3-bc", "small"),
    "td3-bc-critic": (52, "td3-bc-critic", "small"),
    "rebrac": (54, "rebrac", "small"),
    "rebrac-critic": (55, "rebrac-critic", "small"),
    "fql": (56, "fql", "small"),
    "fql-normalized": (57, "fql-normalized", "small"),
}
MODULES = quad, iql, ivr, xql, dql, align_iql, onestep, cql, dtql, sfbc, diffuser, fqe, td3bc, fql
ALGORITHMS = {variant: algorithm for algorithm in MODULES for variant in algorithm.VARIANTS}


def flatten(tree):
    """The tensors of a file: names joined by dots, float32 unless whole numbers, scalars as [1]; no fifth without a sample."""
    flat = {}
    for name, value in tree.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{inner}": x for inner, x in flatten(value).items()}
        else:
            value = np.atleast_1d(np.asarray(value))
            if name.startswith("lambda_fifth_") and np.isnan(value[0]):
                continue
            flat[name] = value.astype(np.int64 if np.issubdtype(value.dtype, np.integer) else np.float32)
    return flat


def distance(found, expected):
    """The largest difference of two arrays' elements, relative to the larger of the element and the array's rms."""
    size = np.maximum(np.sqrt(np.mean(np.square(expected, dtype=float))), np.abs(expected))
    return np.max(np.abs(found - expected) / np.where(size == 0, 1, size))


def shaken(tensors, rng):
    """Every real number changed by a millionth or so of itself."""
    return {
        name: shaken(x, rng) if isinstance(x, dict) else x * (1 + 1e-6 * rng.normal(size=x.shape))
        for name, x in tensors.items()
        if isinstance(x, dict) or not np.issubdtype(x.dtype, np.integer)
    }


def is_stable(algorithm, config, state, inputs, expected):
    """Whether small changes of what it starts from change the outcome little: they do not where large terms cancel."""
    rng, wanted = np.random.default_rng(0), flatten(expected)
    for _ in range(3):
        others = shaken(state, rng), inputs | shaken(inputs, rng)
        found = flatten(algorithm.update(config, *others)[0] | algorithm.act(config, *others))
        if any(distance(found[name], x) > 6e-5 for name, x in wanted.items()):
            return False
    return True


def make(seed, variant, size):
    """Config, state, inputs and expected outcome, drawn again until float32's rounding can do no harm."""
    algorithm, rng = ALGORITHMS[variant], np.random.default_rng(seed)
    config = algorithm.make_config(variant, size)
    for _ in range(1000):
        drawn = algorithm.draw(config, variant, size, rng)
        if drawn and is_stable(algorithm, config, *drawn):
            return config, *drawn
    raise SystemExit(f"{variant} at size {size}: nothing suitable in a thousand draws")


def write(folder, seed, variant, size):
    config, state, inputs, expected = make(seed, variant, size)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    for name, tensors in ("state", state), ("inputs", inputs), ("expected", expected):
        save_file(flatten(tensors), folder / f"{name}.safetensors")


def check(name, made_with):
    """That a committed folder is what the script makes now, within float32's rounding."""
    config, *made = make(*made_with)
    if json.loads((HERE / name / "config.json").read_text()) != config:
        raise SystemExit(f"{name}: config.json differs")
    for file, room, tensors in zip(("state", "inputs", "expected"), (0, 0, 1e-6), made, strict=True):
        found, expected = load_file(HERE / name / f"{file}.safetensors"), flatten(tensors)
        if found.keys() != expected.keys():
            raise SystemExit(f"{name}: {file} has other tensors: {found.keys() ^ expected.keys()}")
        for tensor, x in expected.items():
            y = found[tensor]
            if y.shape != x.shape or y.dtype != x.dtype or not distance(y, x) <= room:
                raise SystemExit(f"{name}: {file} {tensor} differs")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder to write")
    parser.add_argument("--variant", choices=ALGORITHMS, default="quad")
    parser.add_argument("--size", choices=quad.SIZES, default="small")
    parser.add_argument("--all", action="store_true", help="rewrite the committed folders")
    parser.add_argument("--check", action="store_true", help="check the committed folders")
    arguments = parser.parse_args()
    if not (arguments.out or arguments.all or arguments.check):
        parser.error("nothing to do: give --out DIR, --all or --check")
    if arguments.out:
        write(arguments.out, arguments.seed, arguments.variant, arguments.size)
    if arguments.all:
        for name, made_with in FOLDERS.items():
            write(HERE / name, *made_with)
    if arguments.check:
        for name, made_with in FOLDERS.items():
            check(name, made_with)
        print(f"{len(FOLDERS)} folders are as made")


if __name__ == "__main__":
    main()
