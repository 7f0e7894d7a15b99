//! Results of checks.

use std::fmt;

use serde::Serialize;

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

    fn add(&mut self, verdict: &'static str, check: &str, what: String, hint: Option<String>) {
        self.0.push(Finding { verdict, check: check.to_owned(), what, hint });
    }

    /// Fails if a check failed.
    pub fn verdict(&self) -> Result<(), ChecksFailed> {
        let failed = self.0.iter().filter(|finding| finding.verdict == "fail").count();
        if failed == 0 { Ok(()) } else { Err(ChecksFailed { failed, checks: self.0.len() }) }
    }
}

/// Checks failed.
#[derive(Debug, thiserror::Error)]
#[error("{failed} of {checks} checks failed")]
pub struct ChecksFailed {
    failed: usize,
    checks: usize,
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let lines = self.0.iter().map(|Finding { verdict, check, what, hint }| {
            let hint =
                hint.as_ref().map(|hint| format!("\n      hint: {hint}")).unwrap_or_default();
            format!("{:4}  {check:11}  {what}{hint}", verdict.replace("fail", "FAIL"))
        });
        f.write_str(&lines.collect::<Vec<_>>().join("\n"))
    }
}
