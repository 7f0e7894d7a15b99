#!/usr/bin/env bash
# Release check: runs every command that README.md and docs/ name, each as the first one on a fresh machine. That is a clean
# clone of HEAD in a container of rust:1.95-bookworm, without uncommitted files, packages or crates.
#
#   deploy/release-check.sh [NAME ...]      all of NAMES below, in turn, or those
#
# Only compiled dependencies are shared, through the Docker volume quad-release-check: without NAME it begins empty, and with a
# NAME it is what the last run left, which saves most of the time. Needs Docker, a network, and 30 GB of disk; takes about three
# hours on two cores. QUAD_DOCKER_RUN has further arguments of `docker run`, e.g. "--cpus 1". What a command says goes to
# .deps/release-check/NAME.log. Ends with a line for each, and with 1 if one of them failed. Afterwards, this gives back the disk:
# docker volume rm quad-release-check
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

IMAGE=rust:1.95-bookworm
VOLUME=quad-release-check
# In this order, each kind of build first runs after the smallest setup.
NAMES=(wheel tarball test-python build develop install-learner install-evaluator join certificates demo results bench test cuda)
LOGS=$DEPS/release-check

# command_of NAME: what bash is to run in the clone. Where hours are usual, as little as can be asked for.
command_of() {
  case $1 in
    build) echo 'deploy/setup.sh; cargo build --release; target/release/learner presets; target/release/evaluator --version' ;;
    wheel | demo | test | test-python | cuda) echo "deploy/$1.sh" ;;
    tarball) echo 'deploy/tarball.sh; tar -xzf dist/quad-*.tar.gz; quad-*/bin/learner --version; quad-*/bin/evaluator --version' ;;
    develop)
      echo 'deploy/setup.sh --venv; python3 -m venv venv; . venv/bin/activate; pip install maturin'
      echo 'cd python; maturin develop --release; python -c "import quad_rl; print(quad_rl.Policy)"'
      ;;
    install-*) echo "deploy/setup.sh; cargo install --locked --path ${1#*-}; ${1#*-} --version" ;;
    # A learner at that address ends well only if the evaluator scores its policy.
    join)
      cat <<'JOIN'
deploy/join.sh tcp/127.0.0.1:7447 &
until pidof evaluator; do kill -0 $!; sleep 1; done
cargo build --release --locked --package quad-learner
target/release/evaluator collect --env hopper --transitions 2000 --out data/few.hdf5
target/release/learner train --task hopper-demo --dataset data/few.hdf5 --run-dir runs/joined \
  --steps 200 --eval-interval 100 --episodes 2 --listen tcp/127.0.0.1:7447
kill $!
JOIN
      ;;
    certificates) echo 'deploy/zenoh/certificates.sh router box1 localhost' ;;
    results) echo 'deploy/results.sh --seeds 0 --methods bc data/hopper-demo.hdf5' ;;
    bench) echo 'deploy/bench.sh 1' ;;
    *) die "there is no check $1" "the names are ${NAMES[*]}" ;;
  esac
}

# check NAME: runs it in a container of its own. The workspace's own crates are compiled anew, since a clone's files are new.
check() {
  local wanted flags
  wanted=$(command_of "$1")
  read -ra flags <<<"${QUAD_DOCKER_RUN:-}"
  docker run --rm --init "${flags[@]}" --volume "$VOLUME:/src/target" --volume "$SCRATCH/clone:/clone:ro" --workdir /src "$IMAGE" \
    bash -euxc "git init --quiet . && git fetch --quiet /clone HEAD && git checkout --quiet FETCH_HEAD
rm -rf target/criterion target/{release,portable/release}/{learner,evaluator}
$wanted" >"$LOGS/$1.log" 2>&1
}

[ $# -gt 0 ] || { set -- "${NAMES[@]}"; docker volume rm --force "$VOLUME" >/dev/null; }
for name; do
  command_of "$name" >/dev/null
done
make_scratch
mkdir -p "$LOGS"
git bundle create --quiet "$SCRATCH/clone" HEAD
say "$(git rev-parse --short HEAD) in $IMAGE; what is said goes to ${LOGS#"$PWD/"}"
summary=() failed=0
for name; do
  say "$name: $(command_of "$name" | head -n 1)"
  SECONDS=0
  status=0
  check "$name" || status=$?
  verdict=passed
  if [ $status -gt 0 ]; then
    tail -n 15 "$LOGS/$name.log" >&2
    verdict="FAILED with exit code $status" failed=1
  fi
  summary+=("$(printf '%-18s %4d min  %s' "$name" $(((SECONDS + 59) / 60)) "$verdict")")
done
printf '%s\n' "${summary[@]}"
exit $failed
