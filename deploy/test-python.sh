#!/usr/bin/env bash
# Builds the wheel, installs it into a fresh virtual environment (.deps/python) and runs the Python package's tests there.
#
#   deploy/test-python.sh [--built] [PYTEST ARGUMENTS]      --built: take the wheel that is in dist/
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

if [ "${1:-}" = --built ]; then
  shift
  deploy/setup.sh --venv
else
  deploy/wheel.sh
fi
make_scratch
venv=$DEPS/python
say "installing the wheel and python/tests/requirements.txt in .deps/python"
try "is Debian's package python3-venv installed?" python3 -m venv --clear "$venv"
try "is there a network? The tests need Python 3.11 or newer; this is $(python3 --version)" \
  "$venv/bin/python" -m pip install --disable-pip-version-check --no-input --no-compile --requirement python/tests/requirements.txt dist/quad_rl-*.whl
# The wheel's programs, not others that are on PATH.
PATH="$venv/bin:$PATH" timeout --kill-after=10 1800 "$venv/bin/python" -m pytest python/tests "$@" || {
  status=$?
  [ $status -lt 124 ] || die "the Python tests did not end within half an hour"
  exit $status
}
