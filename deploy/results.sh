#!/usr/bin/env bash
# What the demonstration's setting learns from some files, and which part of it is owed to the choice among candidates, which
# to guidance: trains behaviour cloning, DAC and QUAD on each, scores their last five snapshots with one candidate and with
# the best of ten on the same episodes, and prints one table (Markdown) of all that was ever trained this way.
#
#   deploy/results.sh [--seeds "0 1 2"] FILE...
#
#   deploy/results.sh data/hopper-demo.hdf5          the demonstration's own file, which is recorded if it is not there
#   deploy/results.sh --seeds 0 walker2d*.hdf5 antmaze_umaze*.hdf5
#
# A file's name begins with its environment: hopper, halfcheetah, walker2d, antmaze_umaze or antmaze_medium. Runs go to
# runs/results. What is done already is skipped, so it can be interrupted and run in pieces. One run per core at a time,
# each on one thread.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

BIN=target/release
EVALUATIONS=5
EPISODES=20
CANDIDATES=1,10

seeds="0 1 2"
[ "${1:-}" != --seeds ] || { seeds=${2:-}; shift 2; }
if [ $# -eq 0 ] || [ -z "$seeds" ]; then usage >&2; exit 2; fi

# task FILE: the demonstration in the environment that the file's name begins with.
task() {
  case $(basename "$1") in
    hopper*) echo hopper-demo ;;
    halfcheetah*) echo halfcheetah-demo ;;
    walker2d*) echo walker2d-demo ;;
    antmaze_umaze*) echo antmaze-umaze-demo ;;
    antmaze_medium*) echo antmaze-medium-demo ;;
    *) die "$1: the name of a file must begin with its environment" "see $0 --help" ;;
  esac
}

# run FILE GUIDANCE SEED: trains with an evaluator beside it, then scores the last snapshots.
run() {
  local file=$1 guidance=$2 seed=$3 task run learner endpoint evaluator snapshots
  task=$(task "$file")
  run=runs/results/$(basename "$file" .hdf5)-$guidance-seed$seed
  [ ! -e "$run/score.json" ] || return 0
  if [ ! -e "$run/report.json" ]; then
    rm -rf "$run"
    mkdir -p "$run"
    start_learner "$run" --task "$task" --dataset "$file" --agent "guidance=$guidance" --seed "$seed" \
      >"$run/learner.log" 2>&1 || { cat "$run/learner.log" >&2; return 1; }
    $BIN/evaluator serve --connect "$endpoint" --metrics 127.0.0.1:0 >"$run/evaluator.log" 2>&1 &
    evaluator=$!
    wait "$learner" || { tail -n 5 "$run/learner.log" >&2; kill $evaluator; return 1; }
    kill $evaluator
    wait $evaluator || true
  fi
  # Their names are in the order of their steps.
  mapfile -t snapshots < <(printf '%s\n' "$run"/snapshots/*.safetensors | tail -n "$EVALUATIONS")
  $BIN/evaluator score --json --episodes "$EPISODES" --candidates "$CANDIDATES" "${snapshots[@]}" \
    >"$run/score.json.partial" 2>"$run/score.log" || { tail -n 5 "$run/score.log" >&2; return 1; }
  mv "$run/score.json.partial" "$run/score.json"
  say "$run is done"
}
# xargs runs it in other shells.
export -f run task start_learner say die
export NAME BIN EVALUATIONS EPISODES CANDIDATES RAYON_NUM_THREADS=1

for file; do
  task "$file" >/dev/null
done
deploy/setup.sh
cargo build --release --locked --package quad-learner --package quad-evaluator
for file; do
  if [ ! -e "$file" ] && [ "$file" = data/hopper-demo.hdf5 ]; then
    RAYON_NUM_THREADS=$(nproc) $BIN/evaluator collect --env hopper --out "$file"
  fi
  [ -e "$file" ] || die "there is no $file"
done

for seed in $seeds; do
  for file; do
    for guidance in none dac quad; do
      printf '%s\0%s\0%s\0' "$file" "$guidance" "$seed"
    done
  done
done | xargs -0 -P "$(nproc)" -n 3 bash -euc 'run "$@"' run

python3 deploy/results.py runs/results/*
