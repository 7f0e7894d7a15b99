#!/usr/bin/env bash
# Sets up what is missing, builds and runs every test. None is skipped for want of a program to compare with; those that
# need rights (mounts, network namespaces), systemd-analyze or recorded files say so where they are skipped, and those of
# Docker run only when asked for (docs/deployment.md). Arguments go to `cargo test`.
set -euo pipefail
cd "$(dirname "$0")/.."

deploy/setup.sh --tests
# Where setup.sh unpacked Prometheus, if the machine has none of its own.
export PATH="$PATH:$PWD/.deps/prometheus" QUAD_REQUIRE_PEERS=1
cargo test --release --locked --workspace --no-run "$@"
# The disk is to be done with what was built: tests kill programs that wait for it, and say so if it takes too long.
sync
cargo test --release --locked --workspace "$@"
