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
