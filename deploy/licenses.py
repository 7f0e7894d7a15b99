"""Prints the licenses of everything compiled into the programs and the Python module, each text once. Run it in the
repository's folder. For a package without a license text it prints the license that its manifest names."""

import json
import pathlib
import subprocess

# Not `--offline`: cargo asks also for crates that only tests need, which a build does not fetch.
COMMAND = "metadata --format-version 1 --locked --filter-platform x86_64-unknown-linux-gnu --features"
FEATURES = "quad-learner/static,quad-evaluator/static,quad-python/static"
PROGRAMS = {"quad-learner", "quad-evaluator", "quad-python"}
# C sources that a crate compiles, under their own licenses.
WITHIN = {"hdf5-metno-src": ["ext/hdf5/LICENSE"], "libz-sys": ["src/zlib/LICENSE"]}


def linked(metadata):
    """The packages linked into the programs, without build dependencies."""
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    packages = {package["id"]: package for package in metadata["packages"]}
    found, todo = set(), [key for key, package in packages.items() if package["name"] in PROGRAMS]
    while todo:
        key = todo.pop()
        if key not in found:
            found.add(key)
            for dependency in nodes[key]["deps"]:
                if any(kind["kind"] is None for kind in dependency["dep_kinds"]):
                    todo.append(dependency["pkg"])
    return sorted((packages[key] for key in found if packages[key]["source"]), key=lambda package: package["name"])


def texts(package):
    """The files of its folder that are licenses by their names."""
    folder = pathlib.Path(package["manifest_path"]).parent
    files = {file for file in folder.iterdir() if file.name.upper().startswith(("LICEN", "COPYING", "NOTICE", "UNLICENSE"))}
    files |= {folder / name for name in WITHIN.get(package["name"], [])}
    return [file.read_text(errors="replace").strip() for file in sorted(files) if file.is_file()]


asked = subprocess.run(["cargo", *COMMAND.split(), FEATURES], stdout=subprocess.PIPE)
if asked.returncode:
    raise SystemExit(asked.returncode)  # cargo has said why
metadata = json.loads(asked.stdout)
owners = {}
for package in linked(metadata):
    name = f"{package['name']} {package['version']}"
    said = f"{package['license']}, says its manifest, without a text. Authors: {', '.join(package['authors']) or 'not named'}"
    for text in texts(package) or [said]:
        owners.setdefault(text, []).append(name)
print("What is compiled into the programs, and under which licenses.\n")
for text, names in owners.items():
    print("=" * 80, ", ".join(names), "-" * 80, text, sep="\n", end="\n\n")
