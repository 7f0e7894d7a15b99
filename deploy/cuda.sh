#!/usr/bin/env bash
# Builds target/release/learner with support for Nvidia GPUs (`learner train --device cuda`).
#
#   deploy/cuda.sh                 cargo build --release --locked -p quad-learner --features cuda
#   deploy/cuda.sh COMMAND ...     another cargo command in the same environment, e.g.
#                                  deploy/cuda.sh test --release -p quad-algorithms --features cuda golden
#
# Takes the CUDA toolkit whose nvcc is on PATH; where there is none, fetches one into .deps/cuda, for x86_64. Building
# needs no GPU, but the kernels are for one kind of them: CUDA_COMPUTE_CAP, by default 90, Hopper (H100, H200).
set -euo pipefail
cd "$(dirname "$0")/.."
. deploy/common.sh

TOOLKIT=$DEPS/cuda

fetch_toolkit() {
  # The copy is made last, so an equal copy means a complete installation.
  ! cmp -s deploy/cuda.txt "$TOOLKIT/cuda.txt" || return 0
  [ "$(uname -m)" = x86_64 ] ||
    die "deploy/cuda.txt has wheels for x86_64 only" "install Nvidia's CUDA toolkit and put its nvcc on PATH"
  python3 -m pip --version >/dev/null 2>&1 || die "python3 -m pip is not there" "Debian's package is python3-pip"
  say "fetching the CUDA toolkit in deploy/cuda.txt, some 0.7 GB"
  try "is there a network, and does this machine reach PyPI (or what pip.conf names instead)?" \
    python3 -m pip install --disable-pip-version-check --no-input --no-deps --no-compile --only-binary=:all: \
    --python-version 3.11 --platform manylinux_2_27_x86_64 --platform manylinux2014_x86_64 \
    --require-hashes --requirement deploy/cuda.txt --target "$SCRATCH"
  # Names that linkers and build scripts look for.
  local fetched=$SCRATCH/nvidia/cu13 library
  ln -s lib "$fetched/lib64"
  for library in "$fetched"/lib/lib*.so.*; do
    ln -sf "${library##*/}" "${library%.so.*}.so"
  done
  mv "$SCRATCH"/*.dist-info "$fetched" # with the licenses
  cp deploy/cuda.txt "$fetched"
  rm -rf "$TOOLKIT"
  mv "$fetched" "$TOOLKIT"
}

# Without a GPU there is no driver library to link against, so the build links a stub whose functions all return
# CUDA_ERROR_STUB_LIBRARY. The learner loads the real library when it starts.
link_driver() {
  local driver stand_in=$TOOLKIT/lib/stubs/libcuda.so
  driver=$(PATH=$PATH:/sbin ldconfig -p | awk '$1 == "libcuda.so.1" && !found++ { print $NF }')
  if [ -n "$driver" ]; then
    ln -sf "$driver" "$TOOLKIT/lib/libcuda.so"
  elif [ ! -e "$stand_in" ]; then
    mkdir -p "${stand_in%/*}"
    grep -oE '\bcu[A-Z][A-Za-z0-9_]+' "$TOOLKIT/include/cuda.h" | sort -u |
      sed 's/.*/int &(void) { return 34; }/' >"$SCRATCH/libcuda.c"
    try "is the C compiler in order?" cc -shared -Wl,-soname,libcuda.so.1 -o "$SCRATCH/libcuda.so" "$SCRATCH/libcuda.c"
    ln -sf libcuda.so "$stand_in.1"
    mv "$SCRATCH/libcuda.so" "$stand_in"
  fi
}

deploy/setup.sh
make_scratch
if nvcc=$(command -v nvcc); then
  CUDA_HOME=${CUDA_HOME:-$(dirname "$(dirname "$(readlink -f "$nvcc")")")}
else
  fetch_toolkit
  link_driver
  CUDA_HOME=$TOOLKIT
fi
export CUDA_HOME CUDA_PATH=$CUDA_HOME CUDA_COMPUTE_CAP=${CUDA_COMPUTE_CAP:-90} PATH="$CUDA_HOME/bin:$PATH"
export LIBRARY_PATH="$CUDA_HOME/lib64:$CUDA_HOME/lib64/stubs${LIBRARY_PATH:+:$LIBRARY_PATH}"
[ $# -gt 0 ] || set -- build --release --locked -p quad-learner --features cuda
cargo "$@"
