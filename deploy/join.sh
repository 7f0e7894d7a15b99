#!/usr/bin/env bash
# Makes this machine an evaluator: installs what is missing, builds, and serves the learners at ENDPOINT.
#
#   deploy/join.sh ENDPOINT [CERTIFICATES]    e.g.  deploy/join.sh tcp/192.0.2.10:7447
#                                                   deploy/join.sh tls/192.0.2.10:7447 ~/box7
#
# ENDPOINT is the address of a learner (`learner train --listen`) or of its router. CERTIFICATES is the folder that
# deploy/zenoh/certificates.sh made for this machine [default: QUAD_CERTIFICATES, or none]. Ctrl-C stops; no score is lost.
set -euo pipefail
CERTIFICATES=${2:-${QUAD_CERTIFICATES:-}}
if [ -n "$CERTIFICATES" ]; then
  # Relative to the caller's folder.
  QUAD_CERTIFICATES=$(realpath --canonicalize-existing -- "$CERTIFICATES")
  export QUAD_CERTIFICATES
fi
cd "$(dirname "$0")/.."
. deploy/common.sh

[[ $# -ge 1 && $# -le 2 && $1 == */*:* ]] || { usage >&2; exit 2; }

deploy/setup.sh
cargo build --release --locked --package quad-evaluator
exec target/release/evaluator serve --connect "$1"
