#!/usr/bin/env bash
# Tests the system as `docker compose up` runs it, images included: all containers are healthy and none runs as root, a crashed
# learner restarts, and every episode is scored once. Then the same with docker-compose.tls.yml, where evaluators without our
# certificates are refused. Takes half an hour; needs Docker, openssl, and root to change the owner of certificates.
#
# Base images come from a registry or, where there is none, from the script that QUAD_STAND_INS names: it makes stand-ins.
set -euo pipefail
shopt -s inherit_errexit
cd "$(dirname "$0")/.."

export COMPOSE_PROJECT_NAME=quad-test QUAD_ROUTER_PORT=0 QUAD_PROMETHEUS_PORT=0 QUAD_GRAFANA_PULL=never
export QUAD_COLLECT_ARGS="--transitions 5000"
certificates=$(mktemp -d)

compose() { docker compose --progress quiet "$@"; }
containers() { compose ps --all --quiet "$1"; }
fact() { docker inspect --format "$2" "$1"; }
is() { [[ $(fact "$1" "$2") == "$3" ]]; }
has_logged() { [[ $(docker logs "$1" 2>&1) == *"$2"* ]]; }

# within SECONDS COMMAND…: repeats the command until it succeeds.
within() {
  local end=$((SECONDS + $1))
  shift
  until "$@"; do
    ((SECONDS < end)) || { echo "not in time: $*" >&2; return 1; }
    sleep 0.3
  done
}

finish() {
  (($1 == 0)) || compose logs --tail 30
  docker rm --force stranger-1 stranger-2 >/dev/null 2>&1 || true
  compose down --volumes --timeout 5
  rm -rf "$certificates"
}
trap 'finish $?' EXIT

# Waits for the end of the run, which must have that many episodes, each scored once; prints its scores.
scores() {
  local learner
  learner=$(containers learner)
  within 1800 is "$learner" '{{.State.Status}}' exited
  is "$learner" '{{.State.ExitCode}}' 0
  in_learner "learner verify /runs/$QUAD_RUN" | tee /dev/stderr | grep -F "$1 of $1 episodes are scored" >/dev/null
  in_learner "cat /runs/$QUAD_RUN/scores.jsonl"
}
in_learner() { compose run --rm --no-deps --entrypoint bash learner -c "$1"; }

if [[ -n ${QUAD_STAND_INS:-} ]]; then
  # Ours and the Dockerfile's stages have no tag; Grafana is scaled to none.
  mapfile -t images < <(sed -nE 's/^ *image: |^FROM //p' docker-compose.yml deploy/Dockerfile | sed 's/ .*//' | grep : | grep -v '^grafana/')
  "$QUAD_STAND_INS" "${images[@]}"
fi
compose build --quiet learner evaluator

echo "everything at once, with the settings that Compose has"
export QUAD_RUN=whole QUAD_TRAIN_ARGS="--steps 12000 --eval-interval 1000 --episodes 8"
compose up --detach --scale evaluator=4 --scale grafana=0
for service in learner router prometheus evaluator; do
  for container in $(containers "$service"); do
    within 240 is "$container" '{{.State.Health.Status}}' healthy
    [[ ! $(fact "$container" '{{.Config.User}}') =~ ^(0|root)?$ ]]
  done
done
prometheus=$(compose port prometheus 9090)
all_are_scraped() {
  local query='query=count(up{job=~"learner|evaluator"} == 1)'
  [[ $(curl -fsS --get --data-urlencode "$query" "http://$prometheus/api/v1/query") == *',"5"]'* ]]
}
within 240 all_are_scraped
# `docker kill` would be an order, after which the engine starts nothing again.
learner=$(containers learner) started=$(fact "$(containers learner)" '{{.State.StartedAt}}')
is_back() { is "$learner" '{{.State.Status}}' running && ! is "$learner" '{{.State.StartedAt}}' "$started"; }
docker run --rm --pid host --network none --user 0 --entrypoint bash quad/evaluator -c "kill -KILL $(fact "$learner" '{{.State.Pid}}')"
within 240 is_back
evaluators=$(scores 96 | grep -o '"evaluator":"[^"]*"' | sort -u | wc -l)
((evaluators > 1)) || { echo "one evaluator did all the work" >&2; exit 1; }
compose down --volumes --timeout 5

echo "with certificates"
for owner in ours theirs; do
  for role in "router router router" "learner learner" "evaluator evaluator"; do
    # shellcheck disable=SC2086 # several words
    deploy/zenoh/certificates.sh --in "$certificates/$owner" $role
  done
  chmod 755 "$certificates"
  chown -R 10001 "$certificates/$owner"/{router,learner,evaluator}
done
export COMPOSE_FILE=docker-compose.yml:docker-compose.tls.yml QUAD_CERTIFICATES_ROOT=$certificates/ours QUAD_RUN=tls
export QUAD_TRAIN_ARGS="--agent actor.hidden=[64,64,64] --agent critic.hidden=[64,64,64] --agent critics=2 --agent diffusion_steps=2 \
--agent candidates=5 --set batch_size=16 --episodes 4 --steps 8000 --eval-interval 1000"
compose up --detach learner
within 240 has_logged "$(containers learner)" "snapshot handed to evaluation"
# There is work, and at first only evaluators without a certificate of ours to do it.
serve=(quad/evaluator serve --name stranger --connect)
docker run --detach --name stranger-1 --network quad-test_default "${serve[@]}" tcp/router:7447
docker run --detach --name stranger-2 --network quad-test_default --volume "$certificates/theirs/evaluator:/certificates:ro" \
  --env QUAD_CERTIFICATES=/certificates "${serve[@]}" tls/router:7447
for stranger in stranger-1 stranger-2; do within 240 has_logged "$stranger" "no connection to"; done
compose up --detach --no-recreate evaluator
found=$(scores 32)
[[ $found != *stranger* ]]
for stranger in stranger-1 stranger-2; do ! has_logged "$stranger" connected || exit 1; done
echo "the containers do what they should"
