//! Tests of `cli/mod.rs`.

use super::*;
use clap::CommandFactory;

pub(super) fn parse(arguments: &[&str]) -> Result<Cli, clap::Error> {
    Cli::try_parse_from(["learner", "train", "--preset", "hopper-demo", "--dataset", "d.hdf5"].iter().chain(arguments))
}

#[test]
fn definition_is_consistent() {
    Cli::command().debug_assert();
}

#[test]
fn wrong_command_lines_exit_with_2() {
    let wrong: [&[&str]; 10] = [
        &["--audit", "0.5"],
        &["--steps", "0"],
        &["--candidates", "0"],
        &["--seed", "9223372036854775808"],
        &["--set", "agent.tau"],
        &["--listen", "127.0.0.1:7447"],
        &["--listen", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:2"],
        &["--metrics", "9090"],
        &["--device", "tpu"],
        &["--nonsense"],
    ];
    for flags in wrong {
        assert_eq!(parse(flags).unwrap_err().exit_code(), 2, "{flags:?}");
    }
    let unknown = Cli::try_parse_from(["learner", "train", "--preset", "walker", "--dataset", "d"]).unwrap_err();
    assert!(unknown.to_string().contains("walker2d-demo"), "{unknown}");
}
