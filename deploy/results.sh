#!/usr/bin/env bash
# Trains algorithms on datasets in the demonstration's setting, scores the last five snapshots of each run on the same
# episodes, and prints one Markdown table of all runs under runs/results.
#
#   deploy/results.sh [--seeds "0 1 2"] [--methods "bc quad iql"] [--agent KEY=VALUE] [--candidates 1,10] FILE...
#
#   deploy/results.sh data/hopper-demo.hdf5          the demonstration's own file, which is recorded if it is not there
#   deploy/results.sh --methods "bc dac quad" --candidates 1,10 walker2d*.hdf5
#
# A method is the name of an algorithm, or of one of QUAD's variants: bc (behavior cloning) and dac. --candidates sets how
# many actions a policy that draws several draws; the default is the algorithm's. --agent changes a hyper-parameter of all.
# A file's name begins with its environment: hopper, halfcheetah, walker2d, antmaze_umaze or antmaze_medium. Runs go to
# runs/results. Finished runs are skipped, so the script can be interrupted. One run per core at a time, each on one thread.
set -euo pipefail
FROM=$PWD
cd "$(dirname "$0")/.."
. deploy/common.sh

BIN=target/release
AGENT=
EVALUATIONS=5
EPISODES=20
CANDIDATES=

seeds="0 1 2"
methods="bc"
for values in presets/*.toml; do
  case $values in */tasks.toml) ;; *) methods="$methods $(basename "$values" .toml)" ;; esac
done
while [ $# -gt 1 ]; do
  case $1 in
    --seeds) seeds=$2 ;;
    --methods) methods=$2 ;;
    --agent) AGENT=$2 ;;
    --candidates) CANDIDATES=$2 ;;
    *) break ;;
  esac
  shift 2
done
if [ $# -eq 0 ] || [ -z "$seeds" ]; then usage >&2; exit 2; fi
RECORDED=data/hopper-demo.hdf5

# task FILE: the demonstration in the environment that the file's name begins with.
task() {
  case $(basename -- "$1") in
    hopper*) echo hopper-demo ;;
    halfcheetah*) echo halfcheetah-demo ;;
    walker2d*) echo walker2d-demo ;;
    antmaze_umaze*) echo antmaze-umaze-demo ;;
    antmaze_medium*) echo antmaze-medium-demo ;;
    *) die "$1: the name of a file must begin with its environment" "see $0 --help" ;;
  esac
}

# flags METHOD: its algorithm, and what is changed in it.
flags() {
  case $1 in
    bc) echo --agent guidance=none ;;
    dac) echo --agent guidance=dac ;;
    *) echo --algorithm "$1" ;;
  esac
}

# run FILE METHOD SEED: trains with an evaluator beside it, then scores the last snapshots. Evaluations have one episode: they
# are there for the snapshots.
run() {
  local file=$1 method=$2 seed=$3 task run learner endpoint evaluator snapshots
  task=$(task "$file")
  run=runs/results/$(basename "$file" .hdf5)/$method/$seed
  [ ! -e "$run/score.json" ] || return 0
  # An interrupted run has a report, too.
  if [ ! -e "$run/complete" ]; then
    rm -rf "$run"
    mkdir -p "$run"
    # shellcheck disable=SC2046 # Several words.
    start_learner "$run" --task "$task" --dataset "$file" $(flags "$method") ${AGENT:+--agent "$AGENT"} \
      --episodes 1 --seed "$seed" >"$run/learner.log" 2>&1 || { cat "$run/learner.log" >&2; return 1; }
    $BIN/evaluator serve --connect "$endpoint" --http 127.0.0.1:0 >"$run/evaluator.log" 2>&1 &
    evaluator=$!
    wait "$learner" || { tail -n 5 "$run/learner.log" >&2; kill $evaluator; return 1; }
    kill $evaluator
    wait $evaluator || true
    touch "$run/complete"
  fi
  # Their names are in the order of their steps.
  mapfile -t snapshots < <(printf '%s\n' "$run"/snapshots/*.safetensors | tail -n "$EVALUATIONS")
  $BIN/evaluator score --json --episodes "$EPISODES" ${CANDIDATES:+--candidates "$CANDIDATES"} "${snapshots[@]}" \
    >"$run/score.json.partial" 2>"$run/score.log" || { tail -n 5 "$run/score.log" >&2; return 1; }
  mv "$run/score.json.partial" "$run/score.json"
  say "$run is done"
}
# xargs runs it in other shells.
export -f run task flags start_learner say die
export NAME BIN AGENT EVALUATIONS EPISODES CANDIDATES RAYON_NUM_THREADS=1

for file; do
  task "$file" >/dev/null
  shift
  # Relative to the caller's folder.
  if [ "$file" != $RECORDED ]; then
    file=$(cd "$FROM" && realpath --canonicalize-missing --no-symlinks -- "$file")
    [ -e "$file" ] || die "there is no $file"
  fi
  set -- "$@" "$file"
done
deploy/setup.sh
cargo build --release --locked --package quad-learner --package quad-evaluator
for file; do
  if [ ! -e "$file" ]; then
    RAYON_NUM_THREADS=$(nproc) $BIN/evaluator collect --env hopper --out "$file"
  fi
done

for seed in $seeds; do
  for file; do
    for method in $methods; do
      printf '%s\0%s\0%s\0' "$file" "$method" "$seed"
    done
  done
done | xargs -0 -P "$(nproc)" -n 3 bash -euc 'run "$@"' run

python3 deploy/results.py runs/results/*/*/*
