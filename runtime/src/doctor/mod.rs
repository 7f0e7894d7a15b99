//! Checks of a machine for `learner doctor` and `evaluator doctor`. Each program adds its own in its
//! `doctor.rs`.

mod machine;
mod network;

use std::fmt;

use serde::Serialize;

pub use machine::{folder, threads};
pub use network::{certificates, connected, port};

/// Results of checks. Display prints a line for each, with hints below.
#[derive(Debug, Default, Serialize)]
pub struct Findings(Vec<Finding>);

#[derive(Debug, Serialize)]
struct Finding {
    /// `ok`, `warn` or `fail`.
    verdict: &'static str,
    check: String,
    what: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    hint: Option<String>,
}

impl Findings {
    /// Adds a passed check.
    pub fn ok(&mut self, check: &str, what: impl Into<String>) {
        self.add("ok", check, what.into(), None);
    }

    /// Adds a check that found something slow, or something that may fail later.
    pub fn warn(&mut self, check: &str, what: impl Into<String>, hint: impl Into<String>) {
        self.add("warn", check, what.into(), Some(hint.into()));
    }

    /// Adds a failed check.
    pub fn fail(&mut self, check: &str, what: impl Into<String>, hint: impl Into<String>) {
        self.add("fail", check, what.into(), Some(hint.into()));
    }

    /// Adds checks of what a run may not need: one that failed is a warning.
    pub fn append_unneeded(&mut self, checks: Self) {
        let warned = |finding: Finding| match finding.verdict {
            "fail" => Finding { verdict: "warn", ..finding },
            _ => finding,
        };
        self.0.extend(checks.0.into_iter().map(warned));
    }

    fn add(&mut self, verdict: &'static str, check: &str, what: String, hint: Option<String>) {
        let check = check.to_owned();
        self.0.push(Finding { verdict, check, what, hint });
    }

    /// Fails if a check failed.
    pub fn verdict(&self) -> Result<(), ChecksFailed> {
        let failed = self.0.iter().filter(|finding| finding.verdict == "fail");
        match (failed.count(), self.0.len()) {
            (0, _) => Ok(()),
            (failed, checks) => Err(ChecksFailed { failed, checks }),
        }
    }
}

/// Some checks of a machine failed.
#[derive(Debug, thiserror::Error)]
#[error("{failed} of {checks} checks failed")]
pub struct ChecksFailed {
    failed: usize,
    checks: usize,
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut end = "";
        for finding in &self.0 {
            let verdict = finding.verdict.replace("fail", "FAIL");
            write!(f, "{end}{verdict:4}  {:11}  {}", finding.check, finding.what)?;
            if let Some(hint) = &finding.hint {
                write!(f, "\n      hint: {hint}")?;
            }
            end = "\n";
        }
        Ok(())
    }
}
