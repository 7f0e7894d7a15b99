//! Programs that are not ours: Python with packages, Prometheus, openssl, Chromium.

use std::process::Command;

use crate::process::command;

#[path = "../fixtures/python.rs"]
mod python;
use python::missing;
pub use python::python;

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
