#!/usr/bin/env bash
# Sets up what is missing, builds and runs every test but the long ones (CONTRIBUTING.md). None is skipped for want of a program
# to compare with; those that need rights (mounts) or recorded files say so where they are skipped. Arguments go to `cargo test`.
set -euo pipefail
cd "$(dirname "$0")/.."

deploy/setup.sh --tests
# Where setup.sh unpacked Prometheus, if the machine has none of its own.
export PATH="$PATH:$PWD/.deps/prometheus" QUAD_REQUIRE_PEERS=1
# Also the programs, which a test of the whole system starts even if it is the only one.
cargo build --release --locked --bins
cargo test --release --locked --workspace --no-run "$@"
# The disk is to be done with what was built: tests kill programs that wait for it, and say so if it takes too long.
sync
SECONDS=0
cargo test --release --locked --workspace "$@"
echo "the tests took $SECONDS s"
