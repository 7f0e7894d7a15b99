//! How a program shows a result or an error to the user, and its exit code.

use std::fmt;
use std::io::{self, Write};
use std::process::ExitCode;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde::Serialize;

use crate::logging::Logging;

/// Adds a hint to an error: what the user can do, on a line of its own.
pub trait Hint<T> {
    /// The type of the error.
    type Error;

    /// Adds `hint` if this is an error. An error that has a hint keeps it, because that hint is
    /// from closer to the cause.
    fn hint(self, hint: impl fmt::Display) -> anyhow::Result<T>;

    /// As [`hint`](Self::hint), with a hint that depends on the error.
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

/// An error with a hint; an error that has a hint keeps it.
pub fn hinted(error: impl Into<anyhow::Error>, hint: impl fmt::Display) -> anyhow::Error {
    let error = error.into();
    if error.is::<Hinted>() {
        error
    } else {
        Hinted { error, hint: hint.to_string(), unfinished: false }.into()
    }
}

/// An error with a hint that means "not finished": the same command continues the work. The exit
/// code is then [`UNFINISHED`].
pub fn unfinished(error: impl Into<anyhow::Error>, hint: impl fmt::Display) -> anyhow::Error {
    Hinted { error: error.into(), hint: hint.to_string(), unfinished: true }.into()
}

/// The hints of an error.
pub fn hints(error: &anyhow::Error) -> impl Iterator<Item = &str> {
    error.chain().filter_map(|cause| cause.downcast_ref::<Hinted>()).map(|hinted| &*hinted.hint)
}

/// An error with a hint; all else is the wrapped error's.
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

/// The exit code of a program that has not finished and continues when the same command is given
/// again: EX_TEMPFAIL of `sysexits.h`, which a scheduler can tell from a failure.
pub const UNFINISHED: u8 = 75;
/// The exit code of a program that a second signal has ended, as shells report it for a process
/// that SIGINT ended.
pub const ENDED_AT_ONCE: u8 = 130;
/// What the line of an error begins with.
const ERROR: &str = "error: ";
/// How long the program waits for a reader of stderr before it ends.
const LAST_WORDS: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };
/// Bytes that a pipe with free space takes without waiting.
const PIPE: usize = 4096;

/// Text as a terminal may have it: what may come from another user's files and names commands
/// nothing.
pub fn clean(text: &str) -> String {
    text.replace(|c: char| c.is_control() && !matches!(c, '\n' | '\t'), " ")
}

/// Prints a command's result to stdout, [`clean`]; logs go to stderr. A reader that stops early,
/// like `head`, is no error.
///
/// # Errors
/// Stdout cannot be written to.
pub fn print(text: &str) -> anyhow::Result<()> {
    match writeln!(io::stdout(), "{}", clean(text.trim_end())) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => Ok(result?),
    }
}

/// A command's result as JSON, which is indented: people read it, too.
///
/// # Errors
/// Serialization fails, which it does for no result.
pub fn json(result: &impl Serialize) -> anyhow::Result<String> {
    Ok(serde_json::to_string_pretty(result)?)
}

/// Runs `main`, and ends the logging. Prints an error to stderr with its causes and hints. The exit
/// code is 0, or 1 after an error, or 75 if the error is [`unfinished`].
///
/// (clap ends the program with 2 if the command line is wrong.)
pub fn run_main(logging: Logging, main: impl FnOnce() -> anyhow::Result<()>) -> ExitCode {
    wait_for_children();
    let result = main();
    drop(logging);
    let Err(error) = result else { return ExitCode::SUCCESS };
    let unfinished = error
        .chain()
        .filter_map(|cause| cause.downcast_ref::<Hinted>())
        .any(|hinted| hinted.unfinished);
    // If stderr is closed, only the exit code can say something.
    say(show(&error).as_bytes()).ok();
    if unfinished { UNFINISHED.into() } else { ExitCode::FAILURE }
}

/// Makes ended children wait until this process asks how they have ended. A parent that ignores
/// SIGCHLD, as some init scripts do, hands that down; then the system forgets each child at its
/// end.
fn wait_for_children() {
    // SAFETY: no other part of this program handles the signal, whose default action is to do
    // nothing.
    #[allow(unsafe_code)]
    unsafe {
        libc::signal(libc::SIGCHLD, libc::SIG_DFL);
    }
}

/// The error that a program which [`run_main`] ran has printed last, from its log.
pub fn error_in(log: &str) -> Option<&str> {
    log.lines().rev().find_map(|line| line.strip_prefix(ERROR))
}

/// Writes to stderr, and waits for a reader only for a limited time. It does not use
/// [`io::Stderr`], which a blocked log line may have locked, nor another thread, which may take
/// seconds to start if many processes share the processors.
fn say(mut text: &[u8]) -> io::Result<()> {
    let stderr = io::stderr();
    while !text.is_empty()
        && poll(&mut [PollFd::new(&stderr, PollFlags::OUT)], Some(&LAST_WORDS))? > 0
    {
        text = &text[rustix::io::write(&stderr, &text[..text.len().min(PIPE)])?..];
    }
    Ok(())
}

/// An error as the user sees it, [`clean`].
fn show(error: &anyhow::Error) -> String {
    let (mut shown, mut last) = (String::new(), String::new());
    for (depth, cause) in error.chain().enumerate() {
        let text = cause.to_string().trim_end().to_owned();
        // Some errors already contain the text of their cause.
        if depth == 0 {
            shown += &format!("{ERROR}{text}\n");
        } else if !last.contains(&text) {
            shown += &format!("  because: {text}\n");
        }
        last = text;
    }
    for hint in hints(error) {
        shown += &format!("hint: {hint}\n");
    }
    clean(&shown)
}

#[cfg(test)]
mod tests {
    use anyhow::{Context, anyhow};

    use super::*;
    use crate::logging::init_logging;

    fn printed<T>(result: anyhow::Result<T>) -> String {
        show(&result.err().unwrap())
    }

    #[test]
    fn causes_and_the_hint_closest_to_them() {
        let cause: Result<(), io::Error> = Err(io::Error::other("no such file"));
        let result = cause.context("cannot read a.hdf5").hint("record it first").hint("try again");
        let text = "error: cannot learn\n  because: cannot read a.hdf5\n  because: no such file\nhint: record it first\n";
        let printed = printed(result.context("cannot learn"));
        assert_eq!(printed, text);
        assert_eq!(error_in(&format!("error: an older one\n{printed}")), Some("cannot learn"));
        assert_eq!(error_in("all is well\n"), None);
    }

    #[test]
    fn a_quoted_cause_is_not_repeated() {
        let cause = io::Error::other("in use");
        let result: anyhow::Result<()> = Err(cause).with_context(|| "cannot listen: in use");
        assert_eq!(printed(result), "error: cannot listen: in use\n");
    }

    #[test]
    fn what_a_name_or_a_file_says_commands_no_terminal() {
        let named: anyhow::Result<()> =
            Err(anyhow!("a\u{1b}]0;x\u{7}\n\tb")).hint("c\r\u{9b}2J\u{7f}");
        assert_eq!(printed(named), "error: a ]0;x \n\tb\nhint: c  2J \n");
    }

    #[test]
    fn exit_codes() {
        assert_eq!(run_main(init_logging(), || Ok(())), ExitCode::SUCCESS);
        assert_eq!(
            run_main(init_logging(), || Err(anyhow!("an error that a test made"))),
            ExitCode::FAILURE
        );
        let stopped = || {
            Err(unfinished(anyhow!("a stop that a test made"), "go on").context("it did not end"))
        };
        assert_eq!(run_main(init_logging(), stopped), ExitCode::from(75));
    }
}
