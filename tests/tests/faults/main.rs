//! Faults of processes, routers and disks must not lose a score, count one twice, or change a bit
//! of the run.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod disk;
mod folder;
mod kills;
mod make;
