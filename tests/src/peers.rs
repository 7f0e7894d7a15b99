//! Programs that are not ours: Python with packages, Prometheus, openssl, Chromium.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::process::command;

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
            missing(&what, "deploy/setup.sh --tests makes it, QUAD_PYTHON names another");
            None
        }
    }
}

/// Finds a program of Debian's; without it the test is skipped.
pub fn has(program: &str, version: &str) -> bool {
    let output = Command::new(program).arg(version).output();
    let works = output.is_ok_and(|output| output.status.success());
    if !works {
        missing(program, &format!("apt-get install --no-install-recommends {program}"));
    }
    works
}

/// Asks `evaluator doctor` for EGL; without it the test is skipped.
pub fn has_egl() -> bool {
    let output = command("evaluator doctor").output().unwrap();
    let can_draw = String::from_utf8_lossy(&output.stdout).contains("can be made");
    if !can_draw {
        missing("EGL with Mesa's software driver", "install it with: deploy/setup.sh --tests");
    }
    can_draw
}
