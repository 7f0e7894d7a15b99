//! Tests of `config/hyperparameters.rs`.

use toml::toml;

use super::super::tables;
use super::super::tasks;
use super::*;

fn values() -> Values {
    let file = toml! {
        about = "an example"
        given = ["*-v2", "antmaze-*"]
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
    };
    file.try_into().unwrap()
}

#[test]
fn the_pattern_with_more_letters_wins_key_by_key() {
    for (task, steps, seed, rate) in [
        (None, 1, 0, 1.0),
        (Some("hopper-medium-v2"), 1, 0, 1.0),
        (Some("hopper-demo"), 2, 2, 1.0),
        (Some("antmaze-umaze-v0"), 3, 0, 3.0),
        (Some("antmaze-umaze-demo"), 3, 4, 3.0),
    ] {
        let expected = toml! { steps = steps seed = seed agent = { rate = rate, width = 8 } };
        assert_eq!(values().for_task(task), expected, "{task:?}");
    }
}

#[test]
fn a_star_stands_for_any_letters() {
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

#[test]
fn only_benchmarks_of_others_can_lack_their_authors_values() {
    for (task, lacks) in [("hopper-medium-v2", false), ("antmaze-umaze-v0", false), ("hopper-demo", false)] {
        assert_eq!(values().lacks(tasks::named(task).unwrap()), lacks, "{task}");
    }
    let values = Values { given: vec!["*-v2".to_owned()], ..values() };
    assert!(values.lacks(tasks::named("antmaze-umaze-v0").unwrap()));
}

/// Of two patterns with as many letters neither wins.
#[test]
fn in_no_file_two_patterns_are_equally_good_for_a_key() {
    for definition in ALGORITHMS {
        let values = Values::of(&definition).unwrap();
        for task in tasks::all() {
            let groups: Vec<_> = values.groups.iter().filter(|(pattern, _)| fits(pattern, &task.name)).collect();
            let keys: Vec<_> = groups
                .iter()
                .flat_map(|(pattern, table)| tables::keys(table).into_iter().map(|(key, _)| (letters(pattern), key)))
                .collect();
            let different: std::collections::BTreeSet<_> = keys.iter().collect();
            assert_eq!(different.len(), keys.len(), "{} for {}: {keys:?}", definition.name, task.name);
        }
        for pattern in values.groups.keys().chain(&values.given) {
            assert!(tasks::all().iter().any(|task| fits(pattern, &task.name)), "no task fits {pattern}");
        }
    }
}

#[test]
fn every_algorithm_has_every_value_for_every_task() {
    for definition in ALGORITHMS {
        let asked = toml::Table::from_iter([("algorithm".to_owned(), definition.name.into())]);
        for task in tasks::all() {
            let resolved = super::super::resolve(&task.name, &asked).unwrap();
            assert_eq!(
                (&*resolved.algorithm, Some(&*resolved.environment)),
                (definition.name, task.word("environment"))
            );
        }
    }
}
