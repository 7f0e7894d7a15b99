//! The crate against files: its own, h5py's, recorded ones where they are at hand, and broken ones.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

use std::path::{Path, PathBuf};
use std::process::Command;

use quad_dataset::{EnvironmentSpec, environment};

mod broken;
mod round_trip;
mod rules;
mod speed;

fn hopper() -> &'static EnvironmentSpec {
    environment::find("hopper").unwrap()
}

/// Runs `peers.py`; false where there is no Python to run it, unless QUAD_REQUIRE_PEERS=1 asks for one.
fn peers(arguments: &[&str]) -> bool {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = match std::env::var_os("QUAD_PYTHON") {
        Some(python) => PathBuf::from(python),
        None => here.join("../.deps/venv/bin/python"),
    };
    if !python.exists() {
        let required = std::env::var("QUAD_REQUIRE_PEERS").is_ok_and(|value| value == "1");
        assert!(!required, "{} is missing; deploy/setup.sh --tests makes it", python.display());
        eprintln!("skipped, because {} is missing", python.display());
        return false;
    }
    let output = Command::new(python).arg(here.join("tests/d4rl/peers.py")).args(arguments).output().unwrap();
    assert!(output.status.success(), "peers.py {arguments:?}:\n{}", String::from_utf8_lossy(&output.stderr));
    true
}
