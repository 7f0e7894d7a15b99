"""Fails where files of a crate, or of the Python package, import each other in a circle. Reads `use` and `import` lines."""

import re
import subprocess
import sys
from pathlib import Path


def rust_names(tree):
    """The paths of a `use` tree: `a::{b, c::D}` has a::b and a::c::D."""
    prefix, brace, rest = tree.partition("{")
    if not brace:
        return [re.sub(r"\s+as\s+\w+$", "", tree.strip())]
    parts, depth, start = [], 0, 0
    body = rest[: rest.rindex("}")] + ","
    for at, letter in enumerate(body):
        depth += (letter == "{") - (letter == "}")
        if letter == "," and depth == 0:
            parts.append(body[start:at])
            start = at + 1
    return [prefix.strip() + name for part in parts if part.strip() for name in rust_names(part)]


def rust_imports(source):
    """Each crate's files with the files that they use, tests left out."""
    files = {}
    for path in source.rglob("*.rs"):
        module = path.relative_to(source).with_suffix("").parts
        files[module[:-1] if module[-1] in ("lib", "main", "mod") else module] = path
    texts = {name: re.split(r"#\[cfg\(test\)\]\s*(?:#\[[^\]]*\]\s*)*mod \w+ \{", path.read_text())[0] for name, path in files.items()}
    texts = {name: re.sub(r"//.*", "", text) for name, text in texts.items() if not {"tests", "golden", "fixtures"} & set(name)}
    exports = {}
    for name, text in texts.items():
        for tree in re.findall(r"^pub(?:\([\w ]+\))? use ([^;]+);", text, re.M):
            for path in rust_names(tree):
                parts = path.split("::")
                parts = name + tuple(parts) if parts[0] not in ("crate", "self", "super") else absolute(parts, name)
                exports[name + (parts[-1],)] = parts
    arrows = {}
    for name, text in texts.items():
        uses = [path for tree in re.findall(r"(?<!pub )\buse ([^;]+);", text) for path in rust_names(tree)]
        uses += re.findall(r"(?<![\w:])((?:crate|super)(?:::\w+)+)", re.sub(r"\buse [^;]+;", "", text))
        for path in uses:
            parts = path.split("::")
            if parts[0] in ("crate", "self", "super"):
                parts = absolute(parts, name)
            elif name + (parts[0],) in files:
                parts = name + tuple(parts)
            else:
                continue
            seen = set()
            while parts in exports and parts not in seen:
                seen.add(parts)
                parts = exports[parts]
            while parts not in texts and parts:
                parts = parts[:-1]
            if parts != name and (parts in texts):
                arrows.setdefault(files[name], set()).add(files[parts])
    return arrows


def absolute(parts, name):
    at = name
    if parts[0] == "crate":
        return tuple(parts[1:])
    while parts and parts[0] in ("self", "super"):
        at = at[:-1] if parts[0] == "super" else at
        parts = parts[1:]
    return at + tuple(parts)


def python_imports(package):
    arrows = {}
    for path in package.rglob("*.py"):
        for dots, module, names in re.findall(r"^\s*from (\.*)([\w.]*) import ([\w, ]+)", path.read_text(), re.M):
            if not dots:
                continue
            folder = path.parents[len(dots) - 1].joinpath(*filter(None, module.split(".")))
            for target in [folder.with_suffix(".py"), *(folder / f"{name.strip()}.py" for name in names.split(","))]:
                if target.exists() and target.name != "__init__.py":
                    arrows.setdefault(path, set()).add(target)
    return arrows


def circles(arrows):
    """The files that can be reached from themselves."""
    def reached(start):
        seen, todo = set(), list(arrows.get(start, ()))
        while todo:
            if (file := todo.pop()) not in seen:
                seen.add(file)
                todo += arrows.get(file, ())
        return seen

    return sorted(str(file) for file in arrows if file in reached(file))


root = Path(subprocess.check_output(["git", "rev-parse", "--show-toplevel"], text=True).strip())
found = [file for source in sorted(root.glob("*/src")) for file in circles(rust_imports(source))]
found += circles(python_imports(root / "python/py/quad_rl"))
if found:
    sys.exit("these files import each other in circles:\n" + "\n".join(found))
