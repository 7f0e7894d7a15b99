#!/usr/bin/env bash
# How fast this machine trains and evaluates, beside its own peaks and beside JAX, and each kernel beside a library's:
# prints the tables of docs/performance.md and kernels/benches/README.md.
#
#   deploy/bench.sh [ROUNDS]              five rounds if not said otherwise, of two or three minutes each; on an idle machine
#   deploy/bench.sh ROUNDS algorithms     only the gradient steps of all algorithms
#
# QUAD_INSTRUCTIONS=avx2 keeps all of them but JAX's products to what a CPU without AVX-512 has.
# Criterion's own reports are in target/criterion afterwards, every figure in target/bench.json.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

deploy/setup.sh --tests
cargo bench --locked --workspace --no-run
cargo build --release --locked --workspace
[ -e data/hopper-demo.hdf5 ] || target/release/evaluator collect --env hopper --out data/hopper-demo.hdf5
# The peer must compute what the learner does.
"$DEPS/venv/bin/python" -W ignore algorithms/benches/jax_step.py --check >&2
python3 deploy/bench/bench.py "${@:-5}"
[ "${2:-}" = algorithms ] || python3 deploy/bench/service.py
