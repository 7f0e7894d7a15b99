#!/usr/bin/env bash
# Where the demonstration's gain comes from: behaviour cloning, DAC and QUAD, each acting with one candidate and with the
# best of ten, over several seeds, on the demonstration's dataset. Runs what is not there yet, then prints one table.
#
#   deploy/compare.sh [SEEDS]     three seeds if not said otherwise; runs go to runs/compare
#
# One run per core at a time, each on one thread.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

DATASET=data/hopper-demo.hdf5
BIN=target/release
SEEDS=${1:-3}

deploy/setup.sh
cargo build --release --locked --package quad-learner --package quad-evaluator
[ -e "$DATASET" ] || $BIN/evaluator collect --env hopper --out "$DATASET"

# run GUIDANCE CANDIDATES SEED: one learner and its own evaluator.
run() {
  local run=runs/compare/$1-best-of-$2-seed$3 learner endpoint evaluator
  [ ! -e "$run/report.json" ] || return 0
  rm -rf "$run"
  mkdir -p "$run"
  start_learner "$run" --preset hopper-demo --dataset "$DATASET" --guidance "$1" --candidates "$2" --seed "$3" \
    >"$run/learner.log" 2>&1 || { cat "$run/learner.log" >&2; return 1; }
  $BIN/evaluator serve --connect "$endpoint" --metrics 127.0.0.1:0 >"$run/evaluator.log" 2>&1 &
  evaluator=$!
  wait "$learner" || { tail -n 5 "$run/learner.log" >&2; kill $evaluator; return 1; }
  kill $evaluator
  wait $evaluator || true
  say "$run is done"
}
# xargs runs it in other shells.
export -f run start_learner say
export NAME BIN DATASET RAYON_NUM_THREADS=1

for ((seed = 0; seed < SEEDS; seed++)); do
  for guidance in none dac quad; do
    for candidates in 1 10; do
      echo "$guidance $candidates $seed"
    done
  done
done | xargs -P "$(nproc)" -L 1 bash -euc 'run "$@"' run

$BIN/learner report runs/compare/*-seed*
