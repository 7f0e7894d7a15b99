//! Tests of the algorithms' values.

use super::super::{resolve, tasks};
use super::*;

#[test]
fn only_tasks_of_benchmarks_can_lack_values() {
    let of_ogbench = "antmaze-giant-stitch-singletask-task5-v0";
    let patterns = &["*-v2", "antmaze-*"][..];
    for (given, task, expected) in [
        (patterns, "hopper-medium-v2", false),
        (patterns, "antmaze-umaze-v0", false),
        (patterns, "hopper-demo", false),
        (&["*-v2"], "antmaze-umaze-v0", true),
        (&["*-v0"], of_ogbench, true),
        (&["antmaze-*-singletask-*"], of_ogbench, false),
        (&["antmaze-*-singletask-*"], "antmaze-umaze-v0", true),
    ] {
        let text = format!("about = \"an example\"\ngflop = \"1\"\ngiven = {given:?}");
        let values: Values = toml::from_str(&text).unwrap();
        let task = tasks::named(task).unwrap();
        assert_eq!(lacks(&values, task), expected, "{given:?} for {}", task.name);
    }
}

#[test]
fn every_algorithm_has_values_for_every_task() {
    for definition in ALGORITHMS {
        let changes = toml::Table::from_iter([("algorithm".to_owned(), definition.name.into())]);
        for task in tasks::all() {
            let resolved = resolve(&task.name, &changes).unwrap();
            assert_eq!(resolved.algorithm, definition.name);
            assert_eq!(Some(&*resolved.environment), task.text("environment"));
        }
    }
}
