//! What a user gets from a command: exit codes, hints, help, files; and that none of ours is
//! misread by the programs of others.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod alerts;
mod bad_input;
mod command_line;
mod dashboard;
mod datasets;
mod doctor;
mod film;
mod formats;
mod judging;
mod own_data;
mod score;
mod systemd;
