//! Tests of the algorithms' values.

use super::super::{resolve, settings, tasks};
use super::*;

#[test]
fn a_warning_names_the_values_that_are_used() {
    for (name, task, expected) in [
        ("cql", "antmaze-giant-navigate-singletask-v0", Some("its general values are used")),
        ("quad", "antmaze-giant-navigate-singletask-v0", Some("antmaze-*-singletask-* are used")),
        ("td3-bc", "antmaze-umaze-v0", Some("those for antmaze-*-v0 are used")),
        ("quad", "antmaze-umaze-v2", Some("those for antmaze-umaze-v0 are used")),
        ("quad", "antmaze-umaze-v0", None),
        // It is no benchmark's.
        ("quad", "hopper-demo", None),
    ] {
        let task = tasks::named(task).unwrap();
        let warning = not_given(&algorithm(name).unwrap(), task);
        let fits = match expected {
            Some(words) => warning.as_ref().is_some_and(|warning| warning.ends_with(words)),
            None => warning.is_none(),
        };
        assert!(fits, "{name} for {}: {warning:?}", task.name);
    }
}

#[test]
fn every_algorithm_has_values_for_every_task() {
    for definition in ALGORITHMS {
        let changes = toml::Table::from_iter([("algorithm".to_owned(), definition.name.into())]);
        for task in tasks::list() {
            let resolved = resolve(&task.name, &changes);
            // It learns from experience alone, of which this task has none.
            if !definition.needs_data && task.name == "own-data" {
                assert!(resolved.unwrap_err().to_string().contains("0 steps"));
                continue;
            }
            let resolved = resolved.unwrap();
            assert_eq!(resolved.algorithm, definition.name);
            let is_short = resolved.steps <= 40_000;
            assert!(is_short || !task.name.ends_with("-demo"), "{}, {changes}", task.name);
            assert_eq!(Some(&*resolved.environment), task.text("environment"));
        }
    }
}

#[test]
fn values_are_those_of_their_sources() {
    let mut keys: Vec<&str> = Vec::new();
    let mut compared = 0;
    for line in include_str!("../../../../presets/sources.txt").lines() {
        let words = Vec::from_iter(line.split_whitespace());
        let Some((name, rest)) = words.split_first().filter(|(name, _)| **name != "#") else {
            continue;
        };
        if algorithm(name).is_ok() {
            keys = words;
            continue;
        }
        let changes = toml::Table::from_iter([("algorithm".to_owned(), keys[0].into())]);
        let settings = settings::from_experiment(&resolve(name, &changes).unwrap());
        assert_eq!(rest.len(), keys.len() - 1, "{line}");
        for (key, value) in keys[1..].iter().zip(rest) {
            let ours: f64 = settings[*key].parse().unwrap();
            assert_eq!(ours, value.parse::<f64>().unwrap(), "{key} of {} for {name}", keys[0]);
            compared += 1;
        }
    }
    assert!(compared > 150, "{compared}");
}
