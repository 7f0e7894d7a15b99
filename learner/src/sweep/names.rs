//! Names of runs, by the values of all axes: `hopper-demo-quad-tau0.1-seed3`.

use std::path::Path;

use toml::Value;

use super::axes::Combination;

/// The name of a combination, the seed last. It includes axes of one value, so that further values
/// change no name.
pub(super) fn name(combination: &Combination<'_>) -> String {
    let (seed, others): (Vec<_>, Vec<_>) = combination.iter().partition(|(key, _)| *key == "seed");
    let parts = others.into_iter().chain(seed).map(|(key, value)| part(key, value, combination));
    parts.collect::<Vec<_>>().join("-")
}

fn part(key: &str, value: &Value, combination: &Combination<'_>) -> String {
    match (key, value.as_str()) {
        ("task" | "method" | "algorithm", Some(word)) => allowed(word),
        ("preset" | "dataset", Some(path)) if path.contains(['/', '.']) => {
            allowed(&Path::new(path).file_stem().unwrap_or_default().to_string_lossy())
        }
        ("preset" | "dataset", Some(word)) => allowed(word),
        (key, Some(word)) => format!("{}-{}", short(key, combination), allowed(word)),
        (key, None) => format!("{}{}", short(key, combination), allowed(&value.to_string())),
    }
}

/// The last part of a key, or the key if another axis ends like it.
fn short<'a>(key: &'a str, combination: &Combination<'_>) -> &'a str {
    let last = key.rsplit('.').next();
    let same = combination.iter().filter(|(other, _)| other.rsplit('.').next() == last);
    if same.count() > 1 { key } else { last.unwrap_or(key) }
}

/// With a dash for each sequence of characters that are not allowed in a name.
fn allowed(text: &str) -> String {
    let parts = text.split(|c: char| !(c.is_ascii_alphanumeric() || "._-".contains(c)));
    parts.filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-")
}
