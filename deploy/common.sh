# What the scripts that install things share; to be sourced from the repository's folder.
# shellcheck shell=bash

DEPS=$PWD/.deps
NAME=$(basename "$0" .sh)
LOG=$DEPS/$NAME.log

say() { echo "$NAME: $*" >&2; }
die() { printf "$NAME: %s\n" "$@" >&2; exit 1; }

# Runs a command silently; where it fails, shows what it said, then the given hint.
try() {
  local hint=$1
  shift
  "$@" >"$LOG" 2>&1 || { tail -n 15 "$LOG" >&2; die "this failed: $*" "$hint"; }
}
