"""`pip install` of the wheel: the module and the programs start without other libraries."""

import importlib.metadata
import pathlib
import shutil
import subprocess
import sys

import pytest

import quad_rl

BIN = pathlib.Path(sys.executable).parent


@pytest.mark.parametrize("program", ["learner", "evaluator"])
def test_programs_are_on_the_path_and_of_this_version(program):
    assert pathlib.Path(shutil.which(program)).parent == BIN
    said = subprocess.run([program, "--version"], check=True, capture_output=True, text=True, timeout=600).stdout
    assert said.split() == [program, importlib.metadata.version("quad_rl")]


def test_quad_convert_is_on_the_path():
    assert pathlib.Path(shutil.which("quad-convert")).parent == BIN
    said = subprocess.run(["quad-convert", "--help"], check=True, capture_output=True, text=True, timeout=600).stdout
    assert "--observations" in said


def test_quad_convert_tolerates_a_reader_that_stops_early():
    script = "from quad_rl._convert import _print; _print('line\\n' * 100_000)"
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert (process.stderr.read(), process.wait(600)) == (b"", 0)


def test_the_programs_need_only_libraries_of_the_system_and_the_wheel():
    for file in [BIN / "learner", BIN / "evaluator", pathlib.Path(quad_rl.__file__).parent / "_quad_rl.abi3.so"]:
        for line in subprocess.run(["ldd", file], check=True, capture_output=True, text=True, timeout=600).stdout.splitlines():
            name, _, where = line.strip().partition(" => ")
            if "mujoco" in name:
                assert pathlib.Path(where.split()[0]).resolve().is_relative_to(BIN.parent.resolve())
            else:
                assert name.split("/")[-1].startswith(("linux-vdso", "ld-linux", "libc.", "libm.", "libdl.", "libpthread.", "librt."))


def test_the_wheel_contains_the_licenses():
    files = {file.name: file for file in importlib.metadata.files("quad_rl") if "licenses" in file.parts}
    assert {"LICENSE-MIT", "LICENSE-APACHE", "LICENSE-mujoco", "LICENSE-third-party"} <= set(files)
    text = files["LICENSE-third-party"].read_text()
    assert "HDF5 (Hierarchical Data Format 5) Software Library" in text and "Jean-loup Gailly" in text
