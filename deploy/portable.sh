# The build that the wheel and the archive share; to be sourced after common.sh. It is for x86_64 and any Linux with glibc $GLIBC
# or newer: HDF5 and zlib are linked statically, and zig links against that glibc, whichever this machine has.
# shellcheck shell=bash

# RHEL 8's, the oldest that clusters run; libmujoco itself needs 2.27.
GLIBC=2.28
TOOLS=$DEPS/wheel
STAGE=$DEPS/portable

fetch_tools() {
  # The copy is made last, so an equal copy means a complete installation.
  ! cmp -s deploy/wheel.txt "$TOOLS/wheel.txt" || return 0
  say "installing the tools of deploy/wheel.txt in .deps/wheel, some 0.5 GB"
  rm -rf "$TOOLS"
  try "is Debian's package python3-venv installed?" python3 -m venv "$TOOLS"
  try "is there a network, and does this machine reach PyPI (or what pip.conf names instead)?" \
    "$TOOLS/bin/python" -m pip install --disable-pip-version-check --no-input --no-deps --only-binary=:all: \
    --require-hashes --requirement deploy/wheel.txt
  # zig as rustc, cc-rs and cmake call a compiler.
  local language
  for language in cc c++; do
    printf '#!/bin/sh\nexec cargo-zigbuild zig %s -- -fno-sanitize=all -target x86_64-linux-gnu.%s "$@"\n' \
      "$language" "$GLIBC" >"$TOOLS/bin/zig-$language"
    chmod +x "$TOOLS/bin/zig-$language"
  done
  cp deploy/wheel.txt "$TOOLS"
}

# A separate target folder: another linker makes cargo compile everything again.
set_environment() {
  export PATH="$TOOLS/bin:$PATH" CARGO_TARGET_DIR=$PWD/target/portable
  export CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_LINKER=$TOOLS/bin/zig-cc CC=$TOOLS/bin/zig-cc CXX=$TOOLS/bin/zig-c++
}

# check_glibc FILE ...: fails if one of them needs a newer glibc, or a library that is neither glibc's nor MuJoCo's.
check_glibc() {
  local file needs
  for file; do
    needs=$(objdump -T "$file" | grep -o 'GLIBC_2[0-9.]*' | cut -d_ -f2 | sort -Vu | tail -n 1)
    [ "$(printf '%s\n' "$needs" "$GLIBC" | sort -V | tail -n 1)" = "$GLIBC" ] ||
      die "${file##*/} needs glibc $needs, newer than $GLIBC" "is another GLIBC written in deploy/portable.sh? Remove .deps/wheel and target/portable"
    ! objdump -p "$file" | awk '$1 == "NEEDED" { print $2 }' |
      grep -vE '^(libc|libm|libdl|libpthread|librt|ld-linux-x86-64|libmujoco)\.so' ||
      die "${file##*/} needs these libraries, which a bare machine does not have"
    say "${file##*/}: $(du -h "$file" | cut -f1), glibc $needs or newer"
  done
}

# Fills $STAGE with bin/, lib/ and licenses/.
build_portable() {
  [ "$(uname -m)" = x86_64 ] || die "this is for x86_64 only; this is $(uname -m)" "build in a clone: cargo build --release"
  deploy/setup.sh --venv
  make_scratch
  fetch_tools
  set_environment
  rm -rf "$STAGE"
  mkdir -p "$STAGE/bin" "$STAGE/lib" "$STAGE/licenses"
  # First, since it fetches crates: where that fails, it does so before the long build.
  "$TOOLS/bin/python" deploy/licenses.py >"$STAGE/licenses/LICENSE-third-party" ||
    die "the crates' licenses cannot be collected" "is there a network, and does this machine reach crates.io (or its mirror)?"
  say "building the programs; the first time takes ten minutes on two cores"
  cargo build --release --locked -p quad-learner -p quad-evaluator --features quad-learner/static,quad-evaluator/static
  install --strip "$CARGO_TARGET_DIR/release/learner" "$CARGO_TARGET_DIR/release/evaluator" "$STAGE/bin"
  install --mode=644 "$DEPS"/mujoco/libmujoco.so.?* "$STAGE/lib"
  check_glibc "$STAGE"/bin/* "$STAGE"/lib/*
  cp LICENSE-MIT LICENSE-APACHE learner/assets/LICENSE-DejaVu "$STAGE/licenses"
  cp "$DEPS/mujoco/LICENSE" "$STAGE/licenses/LICENSE-mujoco"
  cp "$DEPS/mujoco/LICENSES_THIRD_PARTY.md" "$STAGE/licenses/LICENSE-mujoco-third-party.md"
}
