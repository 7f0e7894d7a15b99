//! Tests of the command line.

use super::*;
use clap::CommandFactory;

fn parse(arguments: &[&str]) -> Result<Cli, clap::Error> {
    let train = ["learner", "train", "--task", "hopper-demo", "--dataset", "d.hdf5"];
    Cli::try_parse_from([&train[..], arguments].concat())
}

fn train(arguments: &[&str]) -> TrainArgs {
    let Command::Train(train) = parse(arguments).unwrap().command else { panic!("not train") };
    *train
}

#[test]
fn definition_is_consistent() {
    Cli::command().debug_assert();
}

#[test]
fn flags_change_the_values_of_the_task() {
    let set = ["--set", "agent.tau=1", "--set", "agent.samples=2"];
    let agent = ["--agent", "tau=2", "--agent", "guidance=dac"];
    let flags = ["--steps", "7", "--eval-interval", "0", "--algorithm", "iql"];
    let expected = toml::toml! { algorithm = "iql" dataset = "d.hdf5" steps = 7 eval_interval = 0 agent = { guidance = "dac", samples = 2, tau = 2 } };
    assert_eq!(train(&[&flags[..], &set, &agent].concat()).changes(), expected);
    let seed = train(&["--set", "seed=2", "--seed", "3"]).changes();
    assert_eq!(seed, toml::toml! { dataset = "d.hdf5" seed = 3 });
}

#[test]
fn only_this_machine_sees_the_page_by_default() {
    assert!(train(&[]).http.ip().is_loopback());
}
