//! Faults must not lose a score, count one twice, or change a bit of the run. CONTRIBUTING.md has a
//! table of the long tests, which are ignored.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod chaos;
mod disk;
mod hanging_disk;
mod locks;
mod power;
mod resume;
mod system;
