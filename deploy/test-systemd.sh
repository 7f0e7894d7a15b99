#!/usr/bin/env bash
# systemd reads the units, with their commented lines, and finds them hardened. Needs systemd-analyze (Debian's package systemd) and
# built programs.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

make_scratch
for program in learner evaluator; do
  unit=$SCRATCH/quad-$program.service
  sed -E "s|/usr/local/bin/$program|$PWD/target/release/$program|; s/^#(LoadCredential|Environment)/\1/" \
    "deploy/systemd/quad-$program.service" >"$unit"
  [ "$(grep -c ^LoadCredential= "$unit")" = 3 ] || die "$unit does not name three parts of a certificate"
  for check in verify 'security --offline=true --threshold=20'; do
    # shellcheck disable=SC2086  # several words
    said=$(systemd-analyze $check "$unit" 2>&1) || die "$said"
    [[ $said != *Unknown* ]] || die "$said"
  done
done
