#!/usr/bin/env bash
# Installs the dependencies that cargo does not: Debian packages, and libmujoco in .deps/mujoco.
#
#   deploy/setup.sh            dependencies of building and running
#   deploy/setup.sh --venv     also python3-venv
#   deploy/setup.sh --tests    also the tests' dependencies: Python packages in .deps/venv, Prometheus in .deps/prometheus
#
# Installs only what is missing. For Debian 12 or newer and Ubuntu 24.04 or newer.
# Packages need root or sudo; everything else goes into .deps, which git ignores.
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

MUJOCO=libmujoco.so.3.17.0
have() { command -v "$1" >/dev/null; }

as_root() {
  if [ "$(id -u)" -eq 0 ]; then "$@"; else sudo "$@"; fi
}

apt_get() {
  try "is there a network, and does this machine reach its package mirror?" \
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=120 "$@"
}

check_rust() {
  have cargo || die "cargo is not there; Rust 1.95 or newer is needed" "see https://rustup.rs, then open a new shell"
}

# Debian packages whose absence shows; named by what they are needed for, so that other sources of it are fine, too.
install_packages() {
  local missing=()
  have cc || missing+=(build-essential)
  have pkg-config || missing+=(pkg-config)
  { have pkg-config && pkg-config --exists hdf5; } || missing+=(libhdf5-dev)
  if [ ! -e "$DEPS/mujoco/$MUJOCO" ]; then
    have python3 || missing+=(python3)
    python3 -m pip --version >/dev/null 2>&1 || missing+=(python3-pip)
  fi
  if [ -n "$VENV" ]; then
    python3 -c 'import ensurepip, venv' >/dev/null 2>&1 || missing+=(python3-venv)
  fi
  if [ -n "$TESTS" ]; then
    have shellcheck || missing+=(shellcheck)
    have openssl || missing+=(openssl)
    # A browser for the page. Ubuntu has no package of it.
    if ! have chromium; then
      ! grep -qs '^ID=ubuntu' /etc/os-release || die "chromium is not there" "install it: snap install chromium"
      missing+=(chromium)
    fi
    # Pictures without a GPU; the file is libegl-mesa0's.
    [ -e /usr/share/glvnd/egl_vendor.d/50_mesa.json ] || missing+=(libegl1 libegl-mesa0 libgl1-mesa-dri)
    # Hosts on one machine, which only root can make.
    if [ "$(id -u)" -eq 0 ]; then
      have tc || missing+=(iproute2)
      have nft || missing+=(nftables)
    fi
  fi
  [ ${#missing[@]} -gt 0 ] || return 0

  have apt-get || die "missing: ${missing[*]} (Debian's names), and there is no apt-get" "install them, then run this again"
  [ "$(id -u)" -eq 0 ] || have sudo ||
    die "missing: ${missing[*]}; installing needs root, and there is no sudo" \
      "run this as root: apt-get install --no-install-recommends ${missing[*]}"
  say "installing with apt-get: ${missing[*]}"
  apt_get update
  apt_get install --yes --no-install-recommends "${missing[@]}"
}

# The wheel's shared library, its license, and the unversioned link that the linker looks for.
fetch_mujoco() {
  local target=$DEPS/mujoco
  # By its version: an older one does not fit the programs.
  [ ! -e "$target/$MUJOCO" ] || return 0
  local machine
  machine=$(uname -m)
  case $machine in
    x86_64 | aarch64) ;;
    *) die "MuJoCo has no wheel for $machine, only for x86_64 and aarch64" ;;
  esac
  say "fetching libmujoco from the wheel in deploy/mujoco.txt"
  try "is there a network, and does this machine reach PyPI (or what pip.conf names instead)?" \
    python3 -m pip download --disable-pip-version-check --no-input --no-deps --only-binary=:all: \
    --python-version 3.11 --platform "manylinux_2_28_$machine" \
    --require-hashes --requirement deploy/mujoco.txt --dest "$SCRATCH"
  mkdir "$SCRATCH/mujoco"
  python3 - "$SCRATCH"/mujoco-*.whl "$SCRATCH/mujoco" "$MUJOCO" <<'PYTHON'
import pathlib, sys, zipfile

wheel, target, library = sys.argv[1:]
with zipfile.ZipFile(wheel) as archive:
    for name in archive.namelist():
        if name == f"mujoco/{library}" or "/licenses/LICENSE" in name:
            pathlib.Path(target, pathlib.PurePosixPath(name).name).write_bytes(archive.read(name))
PYTHON
  ln -s "$MUJOCO" "$SCRATCH/mujoco/libmujoco.so"
  rm -rf "$target"
  mv "$SCRATCH/mujoco" "$target"
}

install_python_packages() {
  local venv=$DEPS/venv wanted=tests/requirements.txt
  # The copy is made last: where it equals what is wanted, everything of it is installed.
  ! cmp -s "$wanted" "$venv/requirements.txt" || return 0
  say "installing the tests' Python packages in .deps/venv"
  try "is Debian's package python3-venv installed?" python3 -m venv "$venv"
  try "is there a network? tests/requirements.txt needs Python 3.11 or newer; this is $(python3 --version)" \
    "$venv/bin/python" -m pip install --disable-pip-version-check --no-input --no-compile --requirement "$wanted"
  cp "$wanted" "$venv/requirements.txt"
}

# Unpacked rather than installed: installing Debian's package would start a service.
fetch_prometheus() {
  { ! have prometheus || ! have promtool; } && [ ! -x "$DEPS/prometheus/promtool" ] || return 0
  say "unpacking Debian's prometheus in .deps/prometheus"
  apt-cache show prometheus >/dev/null 2>&1 || apt_get update
  (cd "$SCRATCH" && try "is there a network, and does this machine reach its package mirror?" apt-get -qq download prometheus)
  dpkg-deb --extract "$SCRATCH"/prometheus_*.deb "$SCRATCH/package"
  rm -rf "$DEPS/prometheus"
  mkdir "$SCRATCH/prometheus"
  cp "$SCRATCH"/package/usr/bin/{prometheus,promtool} "$SCRATCH/prometheus"
  mv "$SCRATCH/prometheus" "$DEPS/prometheus"
}

VENV=
TESTS=
case ${1:-} in
  '') ;;
  --venv) VENV=1 ;;
  --tests) VENV=1 TESTS=1 ;;
  *) usage >&2; exit 2 ;;
esac

make_scratch
check_rust
install_packages
fetch_mujoco
if [ -n "$TESTS" ]; then
  install_python_packages
  fetch_prometheus
fi
