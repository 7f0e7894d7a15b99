#!/usr/bin/env bash
# Installs what is missing, builds, and runs all tests. No test is skipped because a peer (Gymnasium, Prometheus, …) is missing;
# tests that need mounts or recorded files say when they skip. Arguments go to `cargo test`.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

deploy/setup.sh --tests
# setup.sh unpacks Prometheus there if the machine has none.
export PATH="$PATH:$PWD/.deps/prometheus" QUAD_REQUIRE_PEERS=1
# Tests of the whole system start the programs and preload the examples. Without --examples the programs would be built without
# the features that the tests' dependencies turn on, and half of the workspace twice.
cargo build --release --locked --bins --examples
cargo test --release --locked --workspace --no-run "$@"
SECONDS=0
cargo test --release --locked --workspace "$@"
echo "the tests took $SECONDS s"
