//! A user's view of the programs: exit codes, hints, help, files; and that the programs of others
//! read ours.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod alerts;
mod command_line;
mod dashboard;
mod datasets;
mod doctor;
mod film;
mod judging;
mod metrics;
mod own_data;
mod score;
mod systemd;
mod transcripts;
