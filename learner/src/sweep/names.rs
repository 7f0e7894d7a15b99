//! Names of runs, by the values of all axes: `hopper-demo-quad-tau0.1-seed3`.

use std::path::Path;

use toml::Value;

use super::axes::Combination;

/// The name of a combination, the seed last. It includes axes of one value, so that further values
/// change no name.
pub(super) fn name(combination: &Combination<'_>) -> String {
    let mut seed_last = combination.clone();
    seed_last.sort_by_key(|(key, _)| *key == "seed");
    let parts = seed_last.iter().map(|(key, value)| part(key, value, combination));
    Vec::from_iter(parts).join("-")
}

fn part(key: &str, value: &Value, combination: &Combination<'_>) -> String {
    match (key, value.as_str()) {
        ("task" | "method" | "algorithm", Some(word)) => allowed(word),
        ("preset" | "dataset", Some(path)) if path.contains(['/', '.']) => {
            let stem = Path::new(path).file_stem().unwrap_or_default();
            allowed(&stem.to_string_lossy())
        }
        ("preset" | "dataset", Some(word)) => allowed(word),
        (key, Some(word)) => format!("{}-{}", short(key, combination), allowed(word)),
        (key, None) => format!("{}{}", short(key, combination), allowed(&value.to_string())),
    }
}

/// The last part of a key, or the key if another axis ends like it.
fn short<'a>(key: &'a str, combination: &Combination<'_>) -> &'a str {
    let same = |(other, _): &&(&str, _)| last(other) == last(key);
    match combination.iter().filter(same).count() {
        1 => last(key),
        _ => key,
    }
}

fn last(key: &str) -> &str {
    key.rsplit('.').next().unwrap_or(key)
}

/// With a dash for each sequence of characters that are not allowed in a name.
fn allowed(text: &str) -> String {
    let parts = text.split(|c: char| !(c.is_ascii_alphanumeric() || "._-".contains(c)));
    Vec::from_iter(parts.filter(|part| !part.is_empty())).join("-")
}
