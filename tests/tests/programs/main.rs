//! A user's view of the programs: exit codes, hints, help, files; and that the programs of others
//! read ours.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod doctor;
mod film;
mod monitoring;
mod own_data;
mod score;
mod transcripts;
