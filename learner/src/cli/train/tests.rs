//! Tests of `cli/train.rs`.

use super::super::{Command, tests::parse};

#[test]
fn flags_change_the_values_of_the_task() {
    let agent = [
        "--set",
        "agent.tau=1",
        "--set",
        "agent.samples=2",
        "--agent",
        "tau=2",
        "--agent",
        "guidance=dac",
    ];
    let flags =
        [&["--steps", "7", "--eval-interval", "0", "--algorithm", "iql"], &agent[..]].concat();
    let Command::Train(train) = parse(&flags).unwrap().command else { panic!("not train") };
    let expected = toml::toml! { algorithm = "iql" dataset = "d.hdf5" steps = 7 eval_interval = 0 agent = { guidance = "dac", samples = 2, tau = 2 } };
    assert_eq!(train.changes(), expected);
    let Command::Train(train) = parse(&["--set", "seed=2", "--seed", "3"]).unwrap().command else {
        panic!()
    };
    assert_eq!(train.changes(), toml::toml! { dataset = "d.hdf5" seed = 3 });
}

#[test]
fn only_this_machine_sees_the_metrics_unless_told_otherwise() {
    let Command::Train(train) = parse(&[]).unwrap().command else { panic!("not train") };
    assert!(train.http.ip().is_loopback(), "{}", train.http);
}
