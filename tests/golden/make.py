"""Golden numbers: one update of an algorithm, written a second time with JAX in float64.

    make.py --seed N --out DIR [--variant quad|dac|…|iql|all] [--size narrow|small|hopper]
    make.py --all      rewrites the committed folders, which stand beside this file
    make.py --check    checks that the committed folders are what it makes now

Writes folders as README.md beside this file describes them. Nothing here is taken from the Rust side: it is written from
the papers and that page.
"""

import argparse
import importlib
import json
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file, save_file

HERE = Path(__file__).parent

# The scripts of algorithms beside this file. In each, FOLDERS has seed and size of the committed folder of each variant.
SCRIPTS = [importlib.import_module(path.stem) for path in sorted(HERE.glob("*.py")) if path.stem != "make"]
MODULES = [script for script in SCRIPTS if hasattr(script, "FOLDERS")]
FOLDERS = {variant: made_with for module in MODULES for variant, made_with in module.FOLDERS.items()}
ALGORITHMS = {variant: module for module in MODULES for variant in module.FOLDERS}


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
            # In C order, since save_file writes memory as it lies.
            flat[name] = np.ascontiguousarray(value, np.int64 if np.issubdtype(value.dtype, np.integer) else np.float32)
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
    """True if small changes of what it starts from change the outcome little: they do not where large terms cancel."""
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


def write(folder, variant, seed, size):
    config, state, inputs, expected = make(seed, variant, size)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    for name, tensors in ("state", state), ("inputs", inputs), ("expected", expected):
        save_file(flatten(tensors), folder / f"{name}.safetensors")


def check(name, seed, size):
    """That a committed folder is what the script makes now, within float32's rounding."""
    config, *made = make(seed, name, size)
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
    parser.add_argument("--variant", choices=[*ALGORITHMS, "all"], default="quad")
    parser.add_argument("--size", choices=["narrow", "small", "hopper"], default="small")
    parser.add_argument("--all", action="store_true", help="rewrite the committed folders")
    parser.add_argument("--check", action="store_true", help="check the committed folders")
    arguments = parser.parse_args()
    if not (arguments.out or arguments.all or arguments.check):
        parser.error("nothing to do: give --out DIR, --all or --check")
    if arguments.out and arguments.variant == "all":
        for variant in ALGORITHMS:
            write(arguments.out / variant, variant, arguments.seed, arguments.size)
    elif arguments.out:
        write(arguments.out, arguments.variant, arguments.seed, arguments.size)
    if arguments.all:
        for name, made_with in FOLDERS.items():
            write(HERE / name, name, *made_with)
    if arguments.check:
        for name, made_with in FOLDERS.items():
            check(name, *made_with)
        print(f"{len(FOLDERS)} folders are as made")


if __name__ == "__main__":
    main()
