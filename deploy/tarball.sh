#!/usr/bin/env bash
# Makes dist/quad-VERSION-x86_64-linux.tar.gz: learner, evaluator and libmujoco, for machines where nothing can be installed. It
# needs no root, no Python, and glibc 2.28 (Debian 10, Ubuntu 20.04, RHEL 8) or newer.
#
# Building needs what deploy/wheel.sh needs, and is the same build.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh
. deploy/portable.sh

version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml)
folder=quad-$version
build_portable
mkdir -p dist "$SCRATCH/$folder"
cp -r "$STAGE"/* "$SCRATCH/$folder"
cat >"$SCRATCH/$folder/README" <<README
QUAD $version: offline reinforcement learning, for Linux on x86-64 with glibc $GLIBC or newer.

Nothing needs to be installed. Keep bin/ and lib/ beside each other: evaluator finds libmujoco there.

    export PATH="\$PWD/bin:\$PATH"
    evaluator collect --env hopper --out hopper-demo.hdf5                   # records behavior, a minute or two
    learner train --task hopper-demo --dataset hopper-demo.hdf5             # and the evaluators that it starts

licenses/ has the licenses of QUAD, of MuJoCo and of all that is compiled in.
README
archive=dist/$folder-x86_64-linux.tar.gz
tar --create --directory="$SCRATCH" --sort=name --owner=0 --group=0 --numeric-owner "$folder" | gzip --best --no-name >"$archive"
say "$archive: $(du -h "$archive" | cut -f1)"
