# Shared by the scripts of this folder, which source it from the repository's folder. It also answers --help.
# shellcheck shell=bash

DEPS=$PWD/.deps
NAME=$(basename "$0" .sh)
LOG=$DEPS/$NAME.log

say() { echo "$NAME: $*" >&2; }
die() { printf "$NAME: %s\n" "$@" >&2; exit 1; }

# Prints the comment that the script begins with. $0 may be relative to the caller's folder.
usage() { sed -n '2,${/^#/!q; s/^# \?//p}' "$(find deploy -name "$(basename "$0")")"; }
[ "${1:-}" != --help ] || { usage; exit; }

# Runs a command silently; where it fails, shows what it said, then the given hint.
try() {
  local hint=$1
  shift
  "$@" >"$LOG" 2>&1 || { tail -n 15 "$LOG" >&2; die "this failed: $*" "$hint"; }
}

# Makes a folder SCRATCH, which is removed when the script ends.
make_scratch() {
  mkdir -p "$DEPS"
  SCRATCH=$(mktemp -d "$DEPS/$NAME.XXXXXX")
  trap 'rm -rf "$SCRATCH"' EXIT
}

# start_learner RUN ARGUMENT ...: starts `learner train` in the background, with the run folder RUN and further arguments.
# Sets `learner` to its process id and, once it listens, `endpoint` to where; the system chooses the port. Fails if the
# learner ends before.
start_learner() {
  local run=$1
  shift
  rm -f "$run/endpoints.json" # an earlier learner's
  target/release/learner train --run-dir "$run" --listen tcp/127.0.0.1:0 "$@" &
  learner=$!
  until [ -e "$run/endpoints.json" ]; do
    kill -0 "$learner" 2>/dev/null || { wait "$learner"; return; }
    sleep 0.1
  done
  # shellcheck disable=SC2034  # the caller's
  endpoint=$(grep -o 'tcp/[^"]*' "$run/endpoints.json" | head -n 1)
}
