//! Tests of `cli/mod.rs`.

use super::*;
use clap::CommandFactory;

pub(super) fn parse(arguments: &[&str]) -> Result<Cli, clap::Error> {
    Cli::try_parse_from(
        ["learner", "train", "--task", "hopper-demo", "--dataset", "d.hdf5"]
            .iter()
            .chain(arguments),
    )
}

#[test]
fn definition_is_consistent() {
    Cli::command().debug_assert();
}

#[test]
fn wrong_command_lines_exit_with_2() {
    let wrong: [&[&str]; 12] = [
        &["--audit", "0.5"],
        &["--steps", "0"],
        &["--agent", "tau"],
        &["--algorithm", "td3"],
        &["--preset", "hopper-demo"],
        &["--seed", "9223372036854775808"],
        &["--set", "agent.tau"],
        &["--listen", "127.0.0.1:7447"],
        &["--listen", "tcp/127.0.0.1:1", "--connect", "tcp/127.0.0.1:2"],
        &["--http", "9090"],
        &["--device", "tpu"],
        &["--nonsense"],
    ];
    for flags in wrong {
        assert_eq!(parse(flags).unwrap_err().exit_code(), 2, "{flags:?}");
    }
    for (flag, misspelled, answer) in [
        ("--task", "walker", "a similar value exists: 'walker2d-demo'"),
        ("--preset", "walker", "did you mean walker2d-demo"),
        ("--algorithm", "qad", "a similar value exists: 'quad'"),
    ] {
        let unknown = Cli::try_parse_from(["learner", "train", flag, misspelled, "--dataset", "d"])
            .unwrap_err();
        assert!(unknown.to_string().contains(answer), "{unknown}");
    }
    assert!(Cli::try_parse_from(["learner", "train"]).unwrap_err().to_string().contains("--task"));
}
