#!/usr/bin/env bash
# Makes this machine an evaluator: sets up what is missing, builds, and serves the learners that it finds at ENDPOINT.
#
#   deploy/join.sh ENDPOINT    e.g.  deploy/join.sh tcp/192.0.2.10:7447
#
# ENDPOINT is where a learner listens (`learner train --listen`) or its router. Ctrl-C leaves; nobody's scores get lost.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

[[ $# -eq 1 && $1 == */*:* ]] || { usage >&2; exit 2; }

deploy/setup.sh
cargo build --release --locked --package quad-evaluator
exec target/release/evaluator serve --connect "$1"
