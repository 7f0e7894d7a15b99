#!/usr/bin/env bash
# Sets up what is missing, builds and runs every test; none is skipped for want of a peer. Arguments go to `cargo test`.
set -euo pipefail
cd "$(dirname "$0")/.."

deploy/setup.sh --tests
# Where setup.sh unpacked Prometheus, if the machine has none of its own.
export PATH="$PATH:$PWD/.deps/prometheus" QUAD_REQUIRE_PEERS=1
cargo test --release --locked --workspace --no-run "$@"
# The disk is to be done with what was built: tests kill programs that wait for it, and say so if it takes too long.
sync
cargo test --release --locked --workspace "$@"
