//! How a result or an error is shown to the user, and the exit code.

use std::fmt;
use std::io::{self, Write};
use std::process::ExitCode;

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::logging::Logging;

/// Adds advice to an error: what to do about it, on a line of its own.
pub trait Hint<T> {
    /// What may have gone wrong.
    type Error;

    /// If this is an error, `hint` is shown below it. An error that has a hint already keeps that one, which was given closer
    /// to the cause.
    fn hint(self, hint: impl fmt::Display) -> anyhow::Result<T>;

    /// The same, with advice that depends on the error.
    fn hint_of<H: fmt::Display>(self, hint: impl FnOnce(&Self::Error) -> H) -> anyhow::Result<T>;
}

impl<T, E: Into<anyhow::Error>> Hint<T> for Result<T, E> {
    type Error = E;

    fn hint(self, hint: impl fmt::Display) -> anyhow::Result<T> {
        self.map_err(|error| hinted(error, hint))
    }

    fn hint_of<H: fmt::Display>(self, hint: impl FnOnce(&E) -> H) -> anyhow::Result<T> {
        let advice = self.as_ref().err().map(hint);
        match advice {
            Some(advice) => self.hint(advice),
            None => self.map_err(Into::into),
        }
    }
}

/// An error with advice, which is shown below it; one that has advice already keeps that.
pub fn hinted(error: impl Into<anyhow::Error>, hint: impl fmt::Display) -> anyhow::Error {
    let error = error.into();
    if error.is::<Hinted>() { error } else { Hinted { error, hint: hint.to_string(), unfinished: false }.into() }
}

/// An error with advice that is none of the program's: it did not finish, and the same command goes on. The exit code is then
/// [`UNFINISHED`].
pub fn unfinished(error: impl Into<anyhow::Error>, hint: impl fmt::Display) -> anyhow::Error {
    Hinted { error: error.into(), hint: hint.to_string(), unfinished: true }.into()
}

/// The advice that an error has.
pub fn hints(error: &anyhow::Error) -> impl Iterator<Item = &str> {
    error.chain().filter_map(|cause| cause.downcast_ref::<Hinted>()).map(|hinted| &*hinted.hint)
}

/// An error with advice; everything else is the error's own.
#[derive(Debug)]
struct Hinted {
    error: anyhow::Error,
    hint: String,
    unfinished: bool,
}

impl fmt::Display for Hinted {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.error.fmt(f)
    }
}

impl std::error::Error for Hinted {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.error.source()
    }
}

/// The exit code of a program that has not finished, and goes on when the same command is given again: EX_TEMPFAIL of
/// `sysexits.h`, so that a scheduler can tell it from a failure.
const UNFINISHED: u8 = 75;
/// How long the last words wait for stderr to be read.
const LAST_WORDS: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };
/// What a pipe that has room takes without waiting, bytes.
const PIPE: usize = 4096;

/// Prints a command's result to stdout, where logs do not go. The reader may stop at any time, like `head` does.
///
/// # Errors
/// Stdout cannot be written to.
pub fn print(text: &str) -> anyhow::Result<()> {
    match writeln!(io::stdout(), "{}", text.trim_end()) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => Ok(result?),
    }
}

/// Runs `main`, and ends the logging. An error is printed to stderr with its causes and hints; the exit code is then 1, or 75
/// if the error is one of [`unfinished`]; otherwise 0.
///
/// (A wrong command line is 2, which clap sees to.)
pub fn run_main(logging: Logging, main: impl FnOnce() -> anyhow::Result<()>) -> ExitCode {
    let result = main();
    drop(logging);
    let Err(error) = result else { return ExitCode::SUCCESS };
    let unfinished = error.chain().filter_map(|cause| cause.downcast_ref::<Hinted>()).any(|hinted| hinted.unfinished);
    let mut text = Vec::new();
    // With stderr closed, the exit code is all that can be said.
    show(&error, &mut text).and_then(|()| say(&text)).ok();
    if unfinished { UNFINISHED.into() } else { ExitCode::FAILURE }
}

/// Writes to stderr for as long as that takes it. Not by [`io::Stderr`], which a log line that waits for a reader may have
/// locked; nor on another thread, which may take seconds to start where many processes share the processors.
fn say(mut text: &[u8]) -> io::Result<()> {
    let stderr = io::stderr();
    while !text.is_empty() && poll(&mut [PollFd::new(&stderr, PollFlags::OUT)], Some(&LAST_WORDS))? > 0 {
        text = &text[rustix::io::write(&stderr, &text[..text.len().min(PIPE)])?..];
    }
    Ok(())
}

fn show(error: &anyhow::Error, to: &mut impl Write) -> io::Result<()> {
    let mut last = String::new();
    for (depth, cause) in error.chain().enumerate() {
        let text = cause.to_string().trim_end().to_owned();
        // Some errors quote their cause.
        if depth == 0 {
            writeln!(to, "error: {text}")?;
        } else if !last.contains(&text) {
            writeln!(to, "  because: {text}")?;
        }
        last = text;
    }
    for hint in hints(error) {
        writeln!(to, "hint: {hint}")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use anyhow::{Context, anyhow};

    use super::*;
    use crate::logging::init_logging;

    fn printed<T>(result: anyhow::Result<T>) -> String {
        let mut text = Vec::new();
        show(&result.err().unwrap(), &mut text).unwrap();
        String::from_utf8(text).unwrap()
    }

    #[test]
    fn causes_and_the_hint_closest_to_them() {
        let cause: Result<(), io::Error> = Err(io::Error::other("no such file"));
        let result = cause.context("cannot read a.hdf5").hint("record it first").hint("try again");
        let text =
            "error: cannot learn\n  because: cannot read a.hdf5\n  because: no such file\nhint: record it first\n";
        assert_eq!(printed(result.context("cannot learn")), text);
    }

    #[test]
    fn a_quoted_cause_is_not_repeated() {
        let cause = io::Error::other("in use");
        let result: anyhow::Result<()> = Err(cause).with_context(|| "cannot listen: in use");
        assert_eq!(printed(result), "error: cannot listen: in use\n");
    }

    #[test]
    fn exit_codes() {
        assert_eq!(run_main(init_logging(), || Ok(())), ExitCode::SUCCESS);
        assert_eq!(run_main(init_logging(), || Err(anyhow!("an error that a test made"))), ExitCode::FAILURE);
        let stopped = || Err(unfinished(anyhow!("a stop that a test made"), "go on").context("it did not end"));
        assert_eq!(run_main(init_logging(), stopped), ExitCode::from(75));
    }
}
