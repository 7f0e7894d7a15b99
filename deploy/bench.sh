#!/usr/bin/env bash
# Benchmarks training and evaluation on this machine against its peak rates and JAX, and each kernel against a library's.
# Prints the tables of docs/performance.md and kernels/benches/README.md.
#
#   deploy/bench.sh [ROUNDS]                       [default: 5] rounds of two or three minutes each, on an idle machine
#   deploy/bench.sh ROUNDS algorithms [NAME ...]   only the gradient steps of all algorithms, or of these
#
# QUAD_INSTRUCTIONS=avx2 disables AVX-512 in everything but JAX's products.
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
