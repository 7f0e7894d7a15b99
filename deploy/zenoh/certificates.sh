#!/usr/bin/env bash
# Makes certificates for routers, learners and evaluators, and the authority that signs them.
#
#   deploy/zenoh/certificates.sh [--in DIR] [--days N] ROLE NAME [HOST...]
#
#   deploy/zenoh/certificates.sh router router zenoh.example.org 192.0.2.10
#   deploy/zenoh/certificates.sh learner learner
#   deploy/zenoh/certificates.sh evaluator box7
#
# ROLE decides what the certificate allows:
#   router     others connect to it, at one of HOST...
#   learner    publishes weights, answers jobs and scores; with HOST..., evaluators may also connect to it directly
#   evaluator  claims jobs and delivers scores and experience
#   monitor    reads, and changes nothing
# HOST is a name or an address, spelled as in endpoints; localhost and 127.0.0.1 are always added.
#
# The result is the folder DIR/NAME with ca.pem, cert.pem and key.pem, for `--certificates` of learner and evaluator: copy
# it to the machine that it is for. Made again, it is renewed. The authority is DIR/ca, made when it is missing: its key
# (DIR/ca/key.pem) signs, so it stays on this machine, or offline until this runs again: its owner can make any certificate.
#
#   --in DIR   [default: certificates]
#   --days N   how long the certificate is valid [default: 365]; the authority is for ten years, and no certificate for longer
set -euo pipefail
FROM=$PWD
cd "$(dirname "$0")/../.."
. deploy/common.sh

wrong() { printf "$NAME: %s\n" "$@" >&2; usage >&2; exit 2; }

DIR=certificates DAYS=365
while [[ ${1:-} == --* ]]; do
  [ $# -ge 2 ] || wrong "$1 needs a value"
  case $1 in
    # Relative to the caller's folder.
    --in) case $2 in /*) DIR=$2 ;; *) DIR=$FROM/$2 ;; esac ;;
    --days) DAYS=$2 ;;
    *) wrong "there is no option $1" ;;
  esac
  shift 2
done
[ $# -ge 2 ] || wrong "a role and a name are needed"
ROLE=$1 WHO=$2
shift 2
HOSTS=(localhost 127.0.0.1 "$@")

# A role is what its certificates are for, and what deploy/zenoh/router-tls.json5 knows them by: the common name. An
# evaluator's cannot be used to listen, so it cannot pass for a router.
case $ROLE in
  router) purpose=serverAuth ;;
  learner) purpose=serverAuth,clientAuth ;;
  evaluator | monitor) purpose=clientAuth HOSTS=() ;;
  *) wrong "$ROLE is none of the roles" ;;
esac
[[ $ROLE != router || $# -gt 0 ]] || wrong "at which HOST do others connect to the router?"
[[ ${#HOSTS[@]} -gt 0 || $# -eq 0 ]] || wrong "evaluators and monitors only connect to others, so they have no HOST"
# A folder's name and a part of the certificate's subject.
[[ $WHO =~ ^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$ ]] ||
  wrong "the name $WHO is not made of 1 to 64 letters, digits, dots, dashes or underscores"
[ "$WHO" != ca ] || wrong "the name ca is the authority's"
[[ $DAYS =~ ^[0-9]{1,5}$ ]] || wrong "--days takes a number of days, not $DAYS"
DAYS=$((10#$DAYS)) # a leading 0 would mean octal
command -v openssl >/dev/null || die "openssl is not there" "install it: apt-get install --no-install-recommends openssl"

umask 077
make_scratch
mkdir -p "$DIR"

new_key() { # new_key FILE: on the curve that every TLS library has
  try "is this openssl 1.1.1 or newer?" openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256 -out "$1"
}

if [ ! -e "$DIR/ca/key.pem" ] || [ ! -e "$DIR/ca/ca.pem" ]; then
  # A new authority would invalidate every certificate that the old one signed.
  for made in "$DIR"/*/ca.pem "$DIR/ca/key.pem"; do
    [ ! -e "$made" ] || die "$made is there, but not the whole authority: $DIR/ca/ca.pem and $DIR/ca/key.pem" \
      "if they are kept elsewhere, put them back while this runs; for another authority, which no program trusts yet, move $DIR away"
  done
  mkdir -p "$SCRATCH/ca"
  new_key "$SCRATCH/ca/key.pem"
  # A unique name, so that programs can tell authorities apart before they connect.
  try "is the disk full?" openssl req -x509 -new -key "$SCRATCH/ca/key.pem" -days 3650 -out "$SCRATCH/ca/ca.pem" \
    -subj "/O=QUAD/CN=QUAD authority $(openssl rand -hex 4)" \
    -addext "basicConstraints=critical,CA:TRUE,pathlen:0" -addext "keyUsage=critical,keyCertSign"
  rm -rf "$DIR/ca"
  mv "$SCRATCH/ca" "$DIR/ca"
  say "made an authority; who has $DIR/ca/key.pem can make certificates"
fi

{
  echo "basicConstraints = critical, CA:FALSE"
  echo "keyUsage = critical, digitalSignature"
  echo "extendedKeyUsage = $purpose"
  [ ${#HOSTS[@]} -eq 0 ] || echo "subjectAltName = @hosts"
  echo "[hosts]"
  for i in "${!HOSTS[@]}"; do
    if [[ ${HOSTS[i]} =~ ^[0-9.]+$ || ${HOSTS[i]} == *:* ]]; then echo "IP.$i = ${HOSTS[i]}"; else echo "DNS.$i = ${HOSTS[i]}"; fi
  done
} >"$SCRATCH/extensions"

openssl x509 -in "$DIR/ca/ca.pem" -noout -checkend $((DAYS * 24 * 60 * 60)) >/dev/null ||
  die "the authority ($DIR/ca/ca.pem) is not valid for $DAYS more days, and no certificate is good for longer than that" \
    "ask for fewer by --days; or, for another authority, move $DIR away and make all certificates anew"

made=$SCRATCH/$WHO
mkdir "$made"
cp "$DIR/ca/ca.pem" "$made/ca.pem"
new_key "$made/key.pem"
try "is $WHO a name that a certificate can have?" \
  openssl req -new -key "$made/key.pem" -out "$SCRATCH/request" -subj "/O=QUAD/OU=$WHO/CN=quad-$ROLE"
try "are these names or addresses: ${HOSTS[*]}?" \
  openssl x509 -req -in "$SCRATCH/request" -CA "$DIR/ca/ca.pem" -CAkey "$DIR/ca/key.pem" \
  -set_serial "0x$(openssl rand -hex 16)" -days "$DAYS" -extfile "$SCRATCH/extensions" -out "$made/cert.pem"

# File by file, each in one step: programs that run read them when they connect again.
mkdir -p "$DIR/$WHO"
mv "$made"/*.pem "$DIR/$WHO/"
say "made $DIR/$WHO, role $ROLE, valid for $DAYS days${HOSTS[*]:+, at ${HOSTS[*]}}"
