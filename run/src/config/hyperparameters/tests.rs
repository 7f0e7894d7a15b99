//! Tests of the algorithms' values.

use super::super::{ConfigError, resolve, tasks};
use super::*;

#[test]
fn only_tasks_of_benchmarks_can_lack_values() {
    let of_ogbench = "antmaze-giant-stitch-singletask-task5-v0";
    for (benchmark, given, task, expected) in [
        ("D4RL", "*-v2", "hopper-medium-v2", false),
        ("D4RL", "*-v2", "hopper-demo", false),
        ("D4RL", "*-v2", "antmaze-umaze-v0", true),
        ("D4RL", "*-v0", of_ogbench, true),
        ("OGBench", "antmaze-*", of_ogbench, false),
        ("OGBench", "antmaze-*", "antmaze-umaze-v0", true),
    ] {
        let given = format!("given.{benchmark} = [{given:?}]");
        let text = format!("about = \"an example\"\ngflop = \"1\"\n{given}");
        let values: Values = toml::from_str(&text).unwrap();
        let task = tasks::named(task).unwrap();
        assert_eq!(lacks(&values, task), expected, "{given} for {}", task.name);
    }
}

#[test]
fn every_algorithm_has_values_for_every_task() {
    for definition in ALGORITHMS {
        let changes = toml::Table::from_iter([("algorithm".to_owned(), definition.name.into())]);
        for task in tasks::all() {
            let resolved = match resolve(&task.name, &changes) {
                // It learns from practice alone, of which this task has none.
                Err(ConfigError::NoSteps)
                    if definition.name == "rlpd" && task.name == "own-data" =>
                {
                    continue;
                }
                resolved => resolved.unwrap(),
            };
            assert_eq!(resolved.algorithm, definition.name);
            assert_eq!(Some(&*resolved.environment), task.text("environment"));
        }
    }
}
