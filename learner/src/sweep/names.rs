//! What runs are called: by the values of all axes, such as `hopper-demo-quad-tau0.1-seed3`.

use std::path::Path;

use toml::Value;

use super::axes::Combination;

/// The name of a combination. The seed comes last, the other axes in their order. An axis of one
/// value is in it, too, so that further values change no name.
pub(super) fn name(combination: &Combination<'_>) -> String {
    let is_seed = |(key, _): &&(&str, &Value)| *key == "seed";
    let (seed, others): (Vec<_>, Vec<_>) = combination.iter().partition(is_seed);
    let parts = others.into_iter().chain(seed).map(|(key, value)| part(key, value, combination));
    parts.collect::<Vec<_>>().join("-")
}

fn part(key: &str, value: &Value, combination: &Combination<'_>) -> String {
    let file =
        |text: &str| Path::new(text).file_stem().map(|stem| stem.to_string_lossy().into_owned());
    match (key, value.as_str()) {
        ("task" | "method" | "algorithm", Some(word)) => allowed(word),
        ("preset" | "dataset", Some(path)) if path.contains(['/', '.']) => {
            allowed(&file(path).unwrap_or_default())
        }
        ("preset" | "dataset", Some(word)) => allowed(word),
        (key, Some(word)) => format!("{}-{}", short(key, combination), allowed(word)),
        (key, None) => format!("{}{}", short(key, combination), allowed(&value.to_string())),
    }
}

/// The last part of a key, unless another axis has the same.
fn short<'a>(key: &'a str, combination: &Combination<'_>) -> &'a str {
    let last = |key: &'a str| key.rsplit('.').next().unwrap_or(key);
    let same =
        combination.iter().filter(|(other, _)| other.rsplit('.').next() == Some(last(key))).count();
    if same > 1 { key } else { last(key) }
}

/// With a dash for each row of characters that no name may have.
fn allowed(text: &str) -> String {
    let parts = text.split(|c: char| !(c.is_ascii_alphanumeric() || "._-".contains(c)));
    parts.filter(|part| !part.is_empty()).collect::<Vec<_>>().join("-")
}
