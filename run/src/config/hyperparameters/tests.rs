//! Tests of `config/hyperparameters.rs`.

use super::super::{resolve, tasks};
use super::*;

/// The file of an algorithm whose authors give values for these tasks.
fn values(given: &[&str]) -> Values {
    toml::from_str(&format!("about = \"an example\"\ngflop = \"1\"\ngiven = {given:?}")).unwrap()
}

#[test]
fn only_benchmarks_of_others_can_lack_their_authors_values() {
    for (task, expected) in
        [("hopper-medium-v2", false), ("antmaze-umaze-v0", false), ("hopper-demo", false)]
    {
        assert_eq!(
            lacks(&values(&["*-v2", "antmaze-*"]), tasks::named(task).unwrap()),
            expected,
            "{task}"
        );
    }
    let of_ogbench = "antmaze-giant-stitch-singletask-task5-v0";
    for (given, task, expected) in [
        ("*-v2", "antmaze-umaze-v0", true),
        ("*-v0", of_ogbench, true),
        ("antmaze-*-singletask-*", of_ogbench, false),
        ("antmaze-*-singletask-*", "antmaze-umaze-v0", true),
    ] {
        assert_eq!(
            lacks(&values(&[given]), tasks::named(task).unwrap()),
            expected,
            "{given} for {task}"
        );
    }
}

#[test]
fn every_algorithm_has_every_value_for_every_task() {
    for definition in ALGORITHMS {
        let asked = toml::Table::from_iter([("algorithm".to_owned(), definition.name.into())]);
        for task in tasks::all() {
            let resolved = resolve(&task.name, &asked).unwrap();
            assert_eq!(
                (&*resolved.algorithm, Some(&*resolved.environment)),
                (definition.name, task.text("environment"))
            );
        }
    }
}
