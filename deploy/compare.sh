#!/usr/bin/env bash
# Where the demonstration's gain comes from: QUAD and pure behaviour cloning, each acting with one candidate and with the
# best of ten, over several seeds, on the demonstration's dataset. Runs what is not there yet, then prints one table.
#
#   deploy/compare.sh [SEEDS]     three seeds if not said otherwise; runs go to runs/compare
#
# One run per core at a time, each on one thread.
set -euo pipefail
cd "$(dirname "$0")/.."

DATASET=data/hopper-demo.hdf5
BIN=target/release
SEEDS=${1:-3}

deploy/setup.sh
cargo build --release --locked --package quad-learner --package quad-evaluator
[ -e "$DATASET" ] || $BIN/evaluator collect --env hopper --out "$DATASET"

# run GUIDANCE CANDIDATES SEED: one learner and its own evaluator.
run() {
  local run=runs/compare/$1-best-of-$2-seed$3 learner evaluator
  [ ! -e "$run/report.json" ] || return 0
  rm -rf "$run"
  mkdir -p "$run"
  $BIN/learner train --preset hopper-demo --dataset "$DATASET" --run-dir "$run" --listen tcp/127.0.0.1:0 \
    --guidance "$1" --candidates "$2" --seed "$3" >"$run/learner.log" 2>&1 &
  learner=$!
  until [ -e "$run/endpoints.json" ]; do
    kill -0 $learner 2>/dev/null || { cat "$run/learner.log" >&2; return 1; }
    sleep 0.1
  done
  $BIN/evaluator serve --connect "$(grep -o 'tcp/[^"]*' "$run/endpoints.json" | head -n 1)" --metrics 127.0.0.1:0 \
    >"$run/evaluator.log" 2>&1 &
  evaluator=$!
  wait $learner || { tail -n 5 "$run/learner.log" >&2; kill $evaluator; return 1; }
  kill $evaluator
  wait $evaluator || true
  echo "compare: $run is done" >&2
}
export -f run
export BIN DATASET RAYON_NUM_THREADS=1

for ((seed = 0; seed < SEEDS; seed++)); do
  for guidance in none quad; do
    for candidates in 1 10; do
      echo "$guidance $candidates $seed"
    done
  done
done | xargs -P "$(nproc)" -L 1 bash -euc 'run "$@"' run

$BIN/learner report runs/compare/*-seed*
