//! The whole system as `docker compose up` runs it, from the images on.
//!
//! Building the images takes a quarter of an hour, so these tests run only when asked for, and build them once for all.
//! CONTRIBUTING.md has the command.
//!
//! Base images come from a registry or, where there is none, from a script that makes stand-ins for them: the one that
//! QUAD_STAND_INS names, else ../shared/docker/stand-ins.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod compose;
mod images;
mod tls;
mod whole;
