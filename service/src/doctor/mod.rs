//! Checks a machine before a run is trusted to it: what goes wrong in practice, and what to do about it.
//!
//! # Layout
//! - [`machine`]: processor cores, threads, open files, the clock.
//! - [`disk`]: whether a folder can be written to, and how much of it.
//! - [`certificates`]: whether they are good, for whom, and until when.
//! - [`network`]: whether somebody is there to connect to.
//!
//! What only one of the programs needs is in its own `doctor.rs`.

pub mod certificates;
pub mod disk;
pub mod machine;
pub mod network;

use std::fmt;

use serde::Serialize;

/// How a check came out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// As it should be.
    Ok,
    /// It works, but perhaps not for long, or not well.
    Warn,
    /// It does not work.
    Fail,
}

/// What one check found.
#[derive(Debug, Serialize)]
pub struct Finding {
    /// How it came out.
    pub verdict: Verdict,
    /// What was checked, in a word or two.
    pub check: String,
    /// What was found.
    pub what: String,
    /// What to do about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hint: Option<String>,
}

/// What all checks found, in their order. Displayed as a line each, with hints below.
#[derive(Debug, Default, Serialize)]
#[serde(transparent)]
pub struct Findings {
    list: Vec<Finding>,
}

impl Findings {
    /// Adds that something is as it should be.
    pub fn ok(&mut self, check: &str, what: impl Into<String>) {
        self.add(Verdict::Ok, check, what.into(), None);
    }

    /// Adds something that works, but perhaps not for long, or not well.
    pub fn warn(&mut self, check: &str, what: impl Into<String>, hint: impl Into<String>) {
        self.add(Verdict::Warn, check, what.into(), Some(hint.into()));
    }

    /// Adds something that does not work.
    pub fn fail(&mut self, check: &str, what: impl Into<String>, hint: impl Into<String>) {
        self.add(Verdict::Fail, check, what.into(), Some(hint.into()));
    }

    fn add(&mut self, verdict: Verdict, check: &str, what: String, hint: Option<String>) {
        self.list.push(Finding { verdict, check: check.to_owned(), what, hint });
    }

    /// As an indented JSON array.
    ///
    /// # Errors
    /// None that is known; serialising is allowed to fail.
    pub fn json(&self) -> serde_json::Result<String> {
        serde_json::to_string_pretty(self)
    }

    /// # Errors
    /// Some check failed.
    pub fn verdict(&self) -> anyhow::Result<()> {
        let failed = self.list.iter().filter(|finding| finding.verdict == Verdict::Fail).count();
        anyhow::ensure!(failed == 0, "{failed} of {} checks failed", self.list.len());
        Ok(())
    }
}

impl fmt::Display for Findings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.list.iter().map(|finding| finding.check.chars().count()).max().unwrap_or(0);
        for (index, Finding { verdict, check, what, hint }) in self.list.iter().enumerate() {
            let word = match verdict {
                Verdict::Ok => "ok",
                Verdict::Warn => "warn",
                Verdict::Fail => "FAIL",
            };
            let end = if index == 0 { "" } else { "\n" };
            write!(f, "{end}{word:4}  {check:width$}  {what}")?;
            if let Some(hint) = hint {
                write!(f, "\n      hint: {hint}")?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_each_and_an_error_where_something_failed() {
        let mut findings = Findings::default();
        findings.ok("cores", "2");
        findings.warn("disk", "1 GiB free", "make room");
        assert_eq!(findings.to_string(), "ok    cores  2\nwarn  disk   1 GiB free\n      hint: make room");
        assert!(findings.verdict().is_ok());
        findings.fail("router", "nobody there", "start it");
        assert_eq!(findings.verdict().unwrap_err().to_string(), "1 of 3 checks failed");
        let json: serde_json::Value = serde_json::from_str(&findings.json().unwrap()).unwrap();
        assert_eq!(json[2]["verdict"], "fail");
        assert_eq!(json[0].get("hint"), None);
    }
}
