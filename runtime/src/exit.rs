//! Results, errors and exit codes of a program. The programs' errors are [`anyhow::Error`]s.

use std::env;
use std::error::Error;
use std::fmt;
use std::fs::File;
use std::io::{self, Write};
use std::process::ExitCode;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use serde::Serialize;

use crate::logging::Logging;

/// Adds a hint to an error: advice for the user, printed on its own line.
pub trait Hint<T> {
    /// The type of the error.
    type Error;

    /// Adds a hint. An error keeps the hint that it has, which is closer to the cause.
    fn hint(self, hint: impl fmt::Display) -> anyhow::Result<T>;

    /// Adds a hint that depends on the error.
    fn hint_of<H: fmt::Display>(self, hint: impl FnOnce(&Self::Error) -> H) -> anyhow::Result<T>;
}

impl<T, E: Into<anyhow::Error>> Hint<T> for Result<T, E> {
    type Error = E;

    fn hint(self, hint: impl fmt::Display) -> anyhow::Result<T> {
        self.hint_of(|_| hint)
    }

    fn hint_of<H: fmt::Display>(self, hint: impl FnOnce(&E) -> H) -> anyhow::Result<T> {
        self.map_err(|error| {
            let hint = hint(&error);
            hinted(error, hint)
        })
    }
}

/// An error with a hint, unless the error has one already.
pub fn hinted(error: impl Into<anyhow::Error>, hint: impl fmt::Display) -> anyhow::Error {
    let error = error.into();
    match error.is::<Hinted>() {
        true => error,
        false => with_hint(error, hint, false),
    }
}

/// An error that means "not finished": the same command continues the work. The exit code is
/// [`UNFINISHED`].
pub fn unfinished(error: impl Into<anyhow::Error>, hint: impl fmt::Display) -> anyhow::Error {
    with_hint(error.into(), hint, true)
}

/// The hints of an error.
pub fn hints(error: &anyhow::Error) -> impl Iterator<Item = &str> {
    all_hinted(error).map(|hinted| &*hinted.hint)
}

fn with_hint(error: anyhow::Error, hint: impl fmt::Display, unfinished: bool) -> anyhow::Error {
    let hint = hint.to_string();
    Hinted { error, hint, unfinished }.into()
}

fn all_hinted(error: &anyhow::Error) -> impl Iterator<Item = &Hinted> {
    error.chain().filter_map(|cause| cause.downcast_ref())
}

/// An error with a hint; text and cause are the wrapped error's.
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

impl Error for Hinted {
    fn source(&self) -> Option<&(dyn Error + 'static)> {
        self.error.source()
    }
}

/// Exit code of a program that has not finished and continues when the same command is given
/// again: EX_TEMPFAIL of `sysexits.h`, which a scheduler can tell from a failure.
pub const UNFINISHED: u8 = 75;
/// Exit code of a program that a second signal has ended, as shells report it for SIGINT.
pub const ENDED_AT_ONCE: u8 = 130;
/// Environment variable with the path of a file, into which a program that fails writes its error
/// in one line. The file must not exist.
pub const FAILURE_FILE: &str = "QUAD_FAILURE_FILE";
/// Time limit for a reader of stderr before the program ends.
const STDERR_TIMEOUT: Timespec = Timespec { tv_sec: 1, tv_nsec: 0 };
/// Bytes that a pipe with free space takes without waiting.
const PIPE: usize = 4096;

/// Replaces control characters, with which text from another user's files could command a
/// terminal.
pub fn clean(text: &str) -> String {
    text.replace(|c: char| c.is_control() && !matches!(c, '\n' | '\t'), " ")
}

/// An error with its causes, in one line. A cause that an error's text already quotes is left out.
pub fn one_line(error: &dyn Error) -> String {
    let (mut text, mut source) = (error.to_string(), error.source());
    while let Some(error) = source {
        let cause = error.to_string();
        if !text.ends_with(&cause) {
            text = format!("{text}: {cause}");
        }
        source = error.source();
    }
    text
}

/// Prints a command's result to stdout, [`clean`]; logs go to stderr. A reader that stops early,
/// like `head`, is no error.
pub fn print(text: &str) -> anyhow::Result<()> {
    match writeln!(io::stdout(), "{}", clean(text.trim_end())) {
        Err(error) if error.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        result => Ok(result?),
    }
}

/// A command's result as indented JSON.
pub fn json(result: &impl Serialize) -> serde_json::Result<String> {
    serde_json::to_string_pretty(result)
}

/// Runs `main`, and ends the logging. Prints an error to stderr with its causes and hints. The exit
/// code is 0, or 1 after an error, or 75 if the error is [`unfinished`].
///
/// (clap ends the program with 2 if the command line is wrong.)
pub fn run_main(logging: Logging, main: impl FnOnce() -> anyhow::Result<()>) -> ExitCode {
    wait_for_children();
    let result = main();
    drop(logging);
    let Err(error) = result else {
        return ExitCode::SUCCESS;
    };
    let unfinished = all_hinted(&error).any(|hinted| hinted.unfinished);
    // If stderr is closed, only the exit code can say something.
    write_stderr(show(&error).as_bytes()).ok();
    if unfinished {
        return UNFINISHED.into();
    }
    if let Some(path) = env::var_os(FAILURE_FILE) {
        let text = clean(&error.to_string());
        // The reader of the file knows the exit code, too.
        File::create_new(path).and_then(|mut file| file.write_all(text.as_bytes())).ok();
    }
    ExitCode::FAILURE
}

/// Makes ended children wait until this process asks for their exit codes. A parent that ignores
/// SIGCHLD, as some init scripts do, passes that on; then the system forgets each child at its end.
fn wait_for_children() {
    // SAFETY: no other part of this program handles the signal, whose default action is to do
    // nothing.
    #[allow(unsafe_code)]
    unsafe {
        libc::signal(libc::SIGCHLD, libc::SIG_DFL);
    }
}

/// Writes to stderr with a time limit. It does not use [`io::Stderr`], which a blocked log line may
/// have locked, nor another thread, which may take seconds to start on a busy machine.
fn write_stderr(mut text: &[u8]) -> io::Result<()> {
    let stderr = io::stderr();
    while !text.is_empty()
        && poll(&mut [PollFd::new(&stderr, PollFlags::OUT)], Some(&STDERR_TIMEOUT))? > 0
    {
        text = &text[rustix::io::write(&stderr, &text[..text.len().min(PIPE)])?..];
    }
    Ok(())
}

/// An error as the user sees it, [`clean`].
fn show(error: &anyhow::Error) -> String {
    let mut last = error.to_string().trim_end().to_owned();
    let mut shown = format!("error: {last}\n");
    for cause in error.chain().skip(1) {
        let text = cause.to_string().trim_end().to_owned();
        // Some errors already contain the text of their cause.
        if !last.contains(&text) {
            shown += &format!("  because: {text}\n");
        }
        last = text;
    }
    hints(error).for_each(|hint| shown += &format!("hint: {hint}\n"));
    clean(&shown)
}

#[cfg(test)]
mod tests {
    use anyhow::{Context, anyhow};

    use super::*;
    use crate::logging::init_logging;

    #[test]
    fn shows_causes_and_the_innermost_hint_without_control_characters() {
        let io = || io::Error::other("in use");
        let failed = |result: anyhow::Result<()>| result.unwrap_err();
        let unread = Err(io()).context("cannot read a.hdf5");
        for (error, shown) in [
            (
                failed(unread.hint("record it").hint("try again")).context("cannot learn"),
                "error: cannot learn\n  because: cannot read a.hdf5\n  because: in use\nhint: record it\n",
            ),
            (failed(Err(io()).context("cannot listen: in use")), "error: cannot listen: in use\n"),
            (
                failed(Err(anyhow!("a\u{1b}]0;x\u{7}\n\tb")).hint("c\r\u{9b}2J\u{7f}")),
                "error: a ]0;x \n\tb\nhint: c  2J \n",
            ),
        ] {
            assert_eq!(show(&error), shown);
        }
    }

    #[test]
    fn one_line_has_each_cause_once() {
        let error = anyhow::Error::from(io::Error::other("full")).context("b").context("a: b");
        assert_eq!(one_line(&*error), "a: b: full");
    }

    #[test]
    fn exit_codes() {
        let code = |result: anyhow::Result<()>| run_main(init_logging(), || result);
        assert_eq!(code(Ok(())), ExitCode::SUCCESS);
        assert_eq!(code(Err(anyhow!("an error of a test"))), ExitCode::FAILURE);
        let stopped = unfinished(anyhow!("a stop of a test"), "go on").context("it did not end");
        assert_eq!(code(Err(stopped)), ExitCode::from(75));
    }
}
