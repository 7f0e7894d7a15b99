//! Programs that are not ours: Python with packages, Prometheus, openssl.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::process::{command, stdout};

/// Fails the test if QUAD_REQUIRE_PEERS=1 (`deploy/test.sh`), else says that it is skipped.
fn missing(what: &str, remedy: &str) {
    let required = std::env::var_os("QUAD_REQUIRE_PEERS").is_some_and(|value| value == "1");
    assert!(!required, "{what} is missing; {remedy}");
    eprintln!("skipped, because {what} is missing; {remedy}");
}

/// A Python that can import `packages`, or `None` if the test is to be skipped.
pub fn python(packages: &[&str]) -> Option<PathBuf> {
    let venv = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.deps/venv/bin/python");
    let python = std::env::var_os("QUAD_PYTHON").map_or(venv, PathBuf::from);
    let imports = format!("import {}", packages.join(", "));
    match Command::new(&python).args(["-c", &imports]).output() {
        Ok(output) if output.status.success() => Some(python),
        _ => {
            let what = format!("{} with {}", python.display(), packages.join(", "));
            missing(&what, "make it with deploy/setup.sh --tests, or name another by QUAD_PYTHON");
            None
        }
    }
}

/// Runs a script of tests/peers; gives what it printed.
pub fn run_python(python: &Path, script: &str, arguments: &[&Path]) -> String {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("peers").join(script);
    stdout(&Command::new(python).arg(script).args(arguments).output().unwrap())
}

/// Makes certificates with deploy/zenoh/certificates.sh in `folder`; false if the test is to be
/// skipped.
pub fn certificates(folder: &Path, arguments: &[&str]) -> bool {
    if !has("openssl", &["version"], "openssl") {
        return false;
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/zenoh/certificates.sh");
    stdout(&Command::new(script).arg("--in").arg(folder).args(arguments).output().unwrap());
    true
}

/// Finds Debian's package `prometheus`; without it the test is skipped.
pub fn has_prometheus() -> bool {
    ["prometheus", "promtool"].iter().all(|program| has(program, &["--version"], "prometheus"))
}

/// Finds Debian's browser; without it the test is skipped.
pub fn has_chromium() -> bool {
    has("chromium", &["--version"], "chromium")
}

fn has(program: &str, version: &[&str], package: &str) -> bool {
    let found = Command::new(program).args(version).output();
    let found = found.is_ok_and(|output| output.status.success());
    if !found {
        missing(program, &format!("apt-get install --no-install-recommends {package}"));
    }
    found
}

/// Asks `evaluator doctor` for EGL; without it the test is skipped.
pub fn has_egl() -> bool {
    let output = command("evaluator doctor").output().unwrap();
    let found = String::from_utf8_lossy(&output.stdout).contains("can be made");
    if !found {
        missing("EGL with Mesa's software driver", "install it with: deploy/setup.sh --tests");
    }
    found
}
