#!/usr/bin/env bash
# Makes this machine an evaluator: sets up what is missing, builds, and serves the learners that it finds at ENDPOINT.
#
#   deploy/join.sh ENDPOINT [CERTIFICATES]    e.g.  deploy/join.sh tcp/192.0.2.10:7447
#                                                   deploy/join.sh tls/192.0.2.10:7447 ~/box7
#
# ENDPOINT is where a learner listens (`learner train --listen`) or its router. CERTIFICATES is the folder that was made for
# this machine by deploy/zenoh/certificates.sh [default: QUAD_CERTIFICATES, or none]. Ctrl-C leaves; no scores get lost.
set -euo pipefail
CERTIFICATES=${2:-${QUAD_CERTIFICATES:-}}
if [ -n "$CERTIFICATES" ]; then
  # As the caller sees it.
  QUAD_CERTIFICATES=$(realpath -- "$CERTIFICATES")
  export QUAD_CERTIFICATES
fi
cd "$(dirname "$0")/.."
. deploy/common.sh

[[ $# -ge 1 && $# -le 2 && $1 == */*:* ]] || { usage >&2; exit 2; }

deploy/setup.sh
cargo build --release --locked --package quad-evaluator
exec target/release/evaluator serve --connect "$1"
