#!/usr/bin/env bash
# The demonstration: from a file of mediocre Hopper data to a policy that hops, by a learner and two evaluators over Zenoh; then
# a policy that hops on and on, by RLPD, which learns from the same file and from evaluators' episodes.
#
# Installs what is missing, builds, records the dataset, trains, and ends with the run's table, learning curve, a film of its
# best snapshot (where OpenGL is installed) and an HTML report. Run again, it skips finished steps and resumes an interrupted
# run. Ctrl-C stops everything.
#
#   deploy/demo.sh [--fresh]        --fresh: start a new run, and keep the old one under another name
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

TASK=hopper-demo
DATASET=data/hopper-demo.hdf5
RUN=runs/hopper-demo
ONLINE=runs/hopper-online
EVALUATORS=2
BIN=target/release

say "1 of 5: packages and libmujoco; next: build, data, training, online"
deploy/setup.sh
say "2 of 5: building learner and evaluator, 420 crates: 5 to 10 minutes the first time; next: data (one minute), training (two),
  online (three)"
cargo build --release --locked --package quad-learner --package quad-evaluator

mkdir -p data
if [ ! -e "$DATASET" ]; then
  say "3 of 5: recording $DATASET"
  $BIN/evaluator collect --env hopper --out "$DATASET"
fi

if [ -e "$RUN/complete" ] && [ -e "$ONLINE/complete" ] && [ $# -eq 0 ]; then
  $BIN/learner report "$RUN" "$ONLINE" --html "$RUN/report.html"
  echo "learning curves: $RUN/learning_curve.svg $ONLINE/learning_curve.svg"
  echo "run folders: $RUN $ONLINE"
  say "these runs are complete; for others: deploy/demo.sh --fresh"
  exit
fi

# train RUN ARGS...: trains; a complete run only prints its table.
train() {
  local run=$1 status=0
  shift
  $BIN/learner train --task $TASK --dataset $DATASET --run-dir "$run" --evaluators $EVALUATORS "$@" || status=$?
  if [ "$status" -ne 0 ]; then
    say "the learner ended with status $status; run this again to continue"
    exit "$status"
  fi
  touch "$run/complete"
}

say "4 of 5: training on the file alone"
train $RUN "$@"
say "5 of 5: online learning, then the tables, a film and a report"
train $ONLINE --algorithm rlpd "$@"
# Rendering needs packages, which the evaluator names.
if told=$($BIN/evaluator film "$ONLINE" --out "$ONLINE/film.gif" 2>&1); then
  echo "$told"
elif install=$(grep -o 'apt-get install .*egl.*' <<<"$told"); then
  say "for a film of it: $install, then $BIN/evaluator film $ONLINE --out $ONLINE/film.gif"
else
  echo "$told" >&2
fi
# One HTML file with all results.
$BIN/learner report "$RUN" "$ONLINE" --html "$RUN/report.html" >/dev/null
