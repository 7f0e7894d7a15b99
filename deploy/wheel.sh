#!/usr/bin/env bash
# Makes dist/quad_rl-VERSION-cp310-abi3-manylinux_2_28_x86_64.whl: the package quad_rl for any Python from 3.10 on, the
# programs learner and evaluator, and libmujoco. `pip install` puts them into lib/pythonX.Y/site-packages, bin/ and lib/ of its
# environment, where they find each other. Needs nothing there but glibc 2.28 (Debian 10, Ubuntu 20.04, RHEL 8) or newer.
#
# Building needs what deploy/setup.sh installs, and some 0.5 GB of tools from PyPI, which go into .deps/wheel.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh
. deploy/portable.sh

# maturin packs these folders beside the module; git ignores both.
DATA=python/quad_rl._quad_rl.data
LICENSES=python/licenses

build_portable
rm -rf "$DATA" "$LICENSES"
mkdir -p "$DATA/data" dist
cp -r "$STAGE/bin" "$DATA/scripts"
cp -r "$STAGE/lib" "$DATA/data"
cp -r "$STAGE/licenses" "$LICENSES"
say "building the Python module"
# maturin's own check rejects libmujoco beside the module; check_glibc replaces it.
maturin build --quiet --manifest-path python/Cargo.toml --release --locked --features static \
  --compatibility "manylinux_${GLIBC/./_}" --auditwheel skip --out "$SCRATCH"
wheel=$(echo "$SCRATCH"/*.whl)
"$TOOLS/bin/python" -m zipfile --extract "$wheel" "$SCRATCH/content"
check_glibc "$SCRATCH"/content/quad_rl/*.so
[ "$(stat --format=%s "$wheel")" -le 60000000 ] || die "${wheel##*/} is larger than 60 MB: $(du -h "$wheel" | cut -f1)"
rm -f dist/quad_rl-*.whl
mv "$wheel" dist
say "dist/${wheel##*/}: $(du -h "dist/${wheel##*/}" | cut -f1)"
