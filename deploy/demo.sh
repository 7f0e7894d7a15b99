#!/usr/bin/env bash
# The demonstration: from a file of mediocre Hopper data to a policy that hops, by a learner and two evaluators over Zenoh.
#
# Sets up what is missing, builds, records the dataset if it is not there, trains, and ends with the run's table and
# learning curve. Run again, it skips what is done: a run that was interrupted goes on where it was. Ctrl-C stops everything.
#
#   deploy/demo.sh [--fresh]        --fresh: begin another run; the one that is there is kept under another name
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

TASK=hopper-demo
DATASET=data/hopper-demo.hdf5
RUN=runs/hopper-demo
EVALUATORS=2
BIN=target/release

deploy/setup.sh
cargo build --release --locked --package quad-learner --package quad-evaluator

mkdir -p data
if [ ! -e "$DATASET" ]; then
  say "recording $DATASET"
  $BIN/evaluator collect --env hopper --out "$DATASET"
fi

if [ -e "$RUN/complete" ] && [ $# -eq 0 ]; then
  $BIN/learner report "$RUN"
  echo "learning curve: $RUN/learning_curve.svg"
  echo "run folder: $RUN"
  say "this run is complete; for another one: deploy/demo.sh --fresh"
  exit
fi

learner=
evaluators=() # process ids

# Ends what still runs, also when this script is interrupted.
stop() {
  trap '' INT TERM
  kill -TERM $learner "${evaluators[@]}" 2>/dev/null || true
  wait
}
trap stop EXIT
trap 'exit 130' INT
trap 'exit 143' TERM

start_learner "$RUN" --task $TASK --dataset $DATASET "$@"
for ((i = 1; i <= EVALUATORS; i++)); do
  $BIN/evaluator serve --name "evaluator-$i" --connect "$endpoint" --metrics 127.0.0.1:0 >"$RUN/evaluator-$i.log" 2>&1 &
  evaluators+=($!)
done
say "evaluators write to $RUN/evaluator-*.log"

status=0
wait "$learner" || status=$?
if [ "$status" -ne 0 ]; then
  say "the learner ended with status $status; run this again to go on where it was"
  exit "$status"
fi
touch "$RUN/complete"
