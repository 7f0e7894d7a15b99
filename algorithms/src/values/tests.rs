//! Tests of `values.rs`.

use std::collections::BTreeSet;
use toml::toml;

use super::*;
use crate::ALGORITHMS;

fn values() -> Values {
    let file = toml! {
        about = "an example"
        gflop = "1"
        given.D4RL = ["*-v2", "antmaze-*"]
        steps = 1
        seed = 0
        [agent]
        rate = 1.0
        width = 8
        [for."*-demo"]
        steps = 2
        seed = 2
        [for."antmaze-*"]
        steps = 3
        agent.rate = 3
        [for."antmaze-*-demo"]
        seed = 4
        [for."antmaze-*-v0"]
        agent.rate = 4
        [for."*-singletask-*"]
        seed = 5
    };
    file.try_into().unwrap()
}

#[test]
fn the_pattern_with_more_letters_wins_key_by_key() {
    for (task, steps, seed, rate) in [
        (None, 1, 0, 1.0),
        (Some("hopper-medium-v2"), 1, 0, 1.0),
        (Some("hopper-demo"), 2, 2, 1.0),
        (Some("antmaze-umaze-v0"), 3, 0, 4.0),
        // OGBench's, none of D4RL's.
        (Some("antmaze-giant-stitch-singletask-v0"), 1, 5, 1.0),
        (Some("antmaze-umaze-demo"), 3, 4, 3.0),
    ] {
        let expected = toml! { steps = steps seed = seed agent = { rate = rate, width = 8 } };
        assert_eq!(values().for_task(task), expected, "{task:?}");
    }
}

#[test]
fn a_star_stands_for_any_text() {
    for (pattern, name, expected) in [
        ("a-b", "a-b", true),
        ("a-b", "a-bc", false),
        ("*-b", "a-b", true),
        ("a*", "a", true),
        ("a-*-d", "a-b-c-d", true),
        ("a-*-d", "a-d", false),
        ("*ab*", "aab", true),
        ("*é*", "aéb", true),
    ] {
        assert_eq!(fits(pattern, name), expected, "{pattern} {name}");
    }
}

/// The tasks of `presets/tasks.toml`, and OGBench's.
fn tasks() -> Vec<String> {
    let tasks: Table = include_str!("../../../presets/tasks.toml").parse().unwrap();
    let named = tasks["task"]
        .as_array()
        .unwrap()
        .iter()
        .map(|task| task["name"].as_str().unwrap().to_owned());
    named.chain(quad_dataset::benchmarks::tasks().map(|task| task.name)).collect()
}

/// The keys of a group, those of its tables with a dot.
fn keys(group: &Table) -> Vec<String> {
    let inner = |key: &String, value: &Value| match value {
        Value::Table(table) => {
            keys(table).into_iter().map(|rest| format!("{key}.{rest}")).collect()
        }
        _ => vec![key.clone()],
    };
    group.iter().flat_map(|(key, value)| inner(key, value)).collect()
}

/// Two patterns with as many letters would contradict each other: neither wins.
#[test]
fn no_two_patterns_of_a_file_rank_equally_for_a_key() {
    for definition in ALGORITHMS {
        let values = Values::read(definition);
        for task in tasks() {
            let keys: Vec<_> = values
                .groups_for(&task)
                .iter()
                .flat_map(|(pattern, table)| {
                    keys(table).into_iter().map(|key| (letters(pattern), key))
                })
                .collect();
            let different = BTreeSet::from_iter(&keys).len();
            let name = definition.name;
            assert_eq!(different, keys.len(), "{name} for {task}: {keys:?}");
        }
        for pattern in values.groups.keys().chain(values.given.values().flatten()) {
            let fits = tasks().iter().any(|task| fits(pattern, task));
            assert!(fits, "no task fits {pattern}");
        }
    }
}

/// A key that the group leaves out, such as the initial weights, would come from the network that all
/// tasks share.
#[test]
fn a_group_with_another_network_names_all_of_it() {
    for definition in ALGORITHMS {
        let values = Values::read(definition);
        let shared = &values.shared["agent"];
        for (pattern, group) in &values.groups {
            let agent = group.get("agent").and_then(Value::as_table);
            let agent = agent.into_iter().flatten();
            for (name, network) in agent.filter(|(_, value)| value.get("activation").is_some()) {
                for key in shared[name].as_table().unwrap().keys() {
                    let named = network.get(key).is_some();
                    assert!(named, "{}: {key} of {name} for {pattern}", definition.name);
                }
            }
        }
    }
}

#[test]
fn merging_changes_the_named_keys_alone() {
    let mut table = toml::toml! { a = 1.5 b = [1, 2] [c] d = 1 e = "x" };
    let changes = toml! { a = 2 b = [3] [c] e = "y" f = true };
    let expected = toml! { a = 2.0 b = [3] [c] d = 1 e = "y" f = true };
    merge(&mut table, changes);
    assert_eq!(table, expected);
}
