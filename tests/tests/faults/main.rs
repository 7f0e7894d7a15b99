//! What faults must not do: lose a score, count one twice, or change a bit of the run.
//!
//! A short version of each test runs with all others. Of the long ones, which are ignored,
//! CONTRIBUTING.md has a table.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod chaos;
mod disk;
mod hanging_disk;
mod locks;
mod power;
mod resume;
mod system;
