//! Presets: TOML tables that the binary carries, each a short difference on a base.
//!
//! Besides the keys of an [`Experiment`](crate::config::Experiment) a preset may have `base`, the name of an embedded preset
//! that it changes key by key, and `about`, a few words for the list of presets. A preset that names no environment is a
//! base and nothing else.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

use toml::{Table, Value};

use crate::config::ConfigError;

macro_rules! embedded {
    ($($name:literal)*) => { &[$(($name, include_str!(concat!("../../presets/", $name, ".toml")))),*] };
}

/// Name and TOML of each, in the order in which they are listed.
const EMBEDDED: &[(&str, &str)] = embedded![
    "hopper-demo"
    "hopper-demo-iql"
    "halfcheetah-demo"
    "walker2d-demo"
    "antmaze-umaze-demo"
    "antmaze-medium-demo"
    "own-data"
    "hopper-medium-v2"
    "hopper-medium-replay-v2"
    "hopper-medium-expert-v2"
    "walker2d-medium-v2"
    "walker2d-medium-replay-v2"
    "walker2d-medium-expert-v2"
    "halfcheetah-medium-v2"
    "halfcheetah-medium-replay-v2"
    "halfcheetah-medium-expert-v2"
    "antmaze-umaze-v0"
    "antmaze-umaze-diverse-v0"
    "antmaze-medium-play-v0"
    "antmaze-medium-diverse-v0"
    "antmaze-large-play-v0"
    "antmaze-large-diverse-v0"
    "paper"
    "paper-locomotion"
    "paper-antmaze"
    "paper-antmaze-large"
];

/// The names of the embedded presets, bases included.
pub fn names() -> impl Iterator<Item = &'static str> {
    EMBEDDED.iter().map(|(name, _)| *name)
}

/// The short name of a preset: `hopper-demo`, also for a path like `my/hopper-demo.toml`.
pub fn label(preset: &str) -> String {
    let stem = Path::new(preset).file_stem().and_then(|stem| stem.to_str());
    if is_path(preset) { stem.unwrap_or("preset").to_owned() } else { preset.to_owned() }
}

/// Whether this is the path of somebody's own preset rather than the name of an embedded one.
pub fn is_path(preset: &str) -> bool {
    preset.ends_with(".toml")
}

/// A preset (an embedded name, or a path that ends in `.toml`) merged with the bases below it.
///
/// # Errors
/// There is no such preset or base, the file cannot be read, or it is not TOML.
pub fn load(preset: &str) -> Result<Table, ConfigError> {
    let own = own(preset)?;
    let mut table = match own.get("base") {
        None => Table::new(),
        // Only embedded presets are bases, and those have no cycle, so this ends.
        Some(Value::String(base)) if !is_path(base) => load(base)?,
        Some(base) => return Err(ConfigError::Unknown(base.to_string())),
    };
    merge(&mut table, own);
    table.retain(|key, _| key != "base" && key != "about");
    Ok(table)
}

/// What a preset says itself, its bases left out.
fn own(preset: &str) -> Result<Table, ConfigError> {
    let unreadable = |source| ConfigError::Read { path: preset.into(), source };
    let text = match EMBEDDED.iter().find(|(name, _)| *name == preset) {
        Some((_, text)) => (*text).to_owned(),
        None if is_path(preset) => std::fs::read_to_string(preset).map_err(unreadable)?,
        None => return Err(ConfigError::Unknown(preset.to_owned())),
    };
    text.parse().map_err(|source| ConfigError::Parse { preset: preset.to_owned(), source: Box::new(source) })
}

/// Lays `changes` over `table`: tables key by key, anything else in place of what was there. An integer that takes a
/// number's place becomes one, so that 1 and 1.0 are the same setting.
pub fn merge(table: &mut Table, changes: Table) {
    for (key, change) in changes {
        match (table.get_mut(&key), change) {
            (Some(Value::Table(below)), Value::Table(change)) => merge(below, change),
            (Some(Value::Float(below)), Value::Integer(change)) => *below = change as f64,
            (_, change) => drop(table.insert(key, change)),
        }
    }
}

/// Reads `agent.tau=0.5`: a dotted key and a value in TOML's notation, where a word needs no quotes.
///
/// # Errors
/// A sentence for whoever typed it.
pub fn parse_assignment(text: &str) -> Result<Table, String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE, for example agent.tau=0.5")?;
    let quoted = || format!("{key} = {}", Value::String(value.trim().to_owned()));
    text.parse().or_else(|_| quoted().parse()).map_err(|_| format!("{key:?} is no key like agent.tau"))
}

/// The first key that no preset has, or under `agent` no preset of the same algorithm, with those that are most like it.
/// Every key that there is stands in some preset, which a test sees to.
pub(crate) fn unknown_key(table: &Table) -> Option<(String, Vec<String>)> {
    let presets: Vec<Table> = names().filter_map(|name| load(name).ok()).collect();
    let same = |preset: &Table| preset.get("algorithm") == table.get("algorithm");
    let of_agent = |key: &str| key.starts_with("agent.");
    let of_algorithm = |preset| keys(preset).into_iter().filter(move |(key, _)| same(preset) || !of_agent(key));
    let known: BTreeSet<String> = presets.iter().flat_map(of_algorithm).map(|(key, _)| key).collect();
    // An algorithm that nobody knows is a problem of its own.
    let checked = |key: &str| !of_agent(key) || presets.iter().any(same);
    let mut all = keys(table).into_iter().map(|(key, _)| key);
    let unknown = all.find(|key| checked(key) && !known.contains(key))?;
    let nearest = nearest(&unknown, known.iter().map(String::as_str)).into_iter().map(str::to_owned).collect();
    Some((unknown, nearest))
}

/// The values of a table and of the tables in it, with dotted keys.
pub(crate) fn keys(table: &Table) -> Vec<(String, &Value)> {
    let mut all = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => {
                all.extend(keys(inner).into_iter().map(|(rest, value)| (format!("{key}.{rest}"), value)));
            }
            value => all.push((key.clone(), value)),
        }
    }
    all
}

/// Up to three of the known words, the most similar first: few letters differ, or the word is part of them. Of dotted keys
/// only the last part counts, so that `tau` is answered with `agent.tau`.
pub fn nearest<'a>(word: &str, known: impl IntoIterator<Item = &'a str>) -> Vec<&'a str> {
    let last = |word: &'a str| word.rsplit('.').next().unwrap_or(word);
    let word = word.rsplit('.').next().unwrap_or(word);
    let likeness = |known| strsim::normalized_damerau_levenshtein(word, known);
    let mut similar: Vec<_> = known.into_iter().map(|known| (likeness(last(known)), known)).collect();
    similar.retain(|(likeness, known)| *likeness > 0.6 || last(known).contains(word));
    similar.sort_by(|a, b| b.0.total_cmp(&a.0));
    similar.into_iter().take(3).map(|(_, known)| known).collect()
}

/// The list of all presets for people: what each is for and what is special about it.
///
/// # Errors
/// None that the tests have not found before.
pub fn list() -> Result<String, ConfigError> {
    let mut rows = vec![["preset", "environment", "dataset", "what is special"].map(str::to_owned)];
    let mut bases = Vec::new();
    for name in names() {
        let table = load(name)?;
        let word = |key| table.get(key).and_then(Value::as_str).unwrap_or("-").to_owned();
        match table.contains_key("environment") {
            true => rows.push([name.to_owned(), word("environment"), word("dataset"), special(&own(name)?)]),
            false => bases.push(name),
        }
    }
    let width = |column: usize| rows.iter().map(|row| row[column].len()).max().unwrap_or(0);
    let widths = [width(0), width(1), width(2)];
    let mut text = String::new();
    for [name, environment, dataset, special] in &rows {
        let [a, b, c] = widths;
        // Writing to a string cannot fail.
        writeln!(text, "{name:a$}  {environment:b$}  {dataset:c$}  {special}").ok();
    }
    writeln!(text, "\nBases of these, which name no environment: {}", bases.join(", ")).ok();
    Ok(text)
}

/// What a preset says about itself, or its differences from its base.
fn special(own: &Table) -> String {
    let word = |key| own.get(key).and_then(Value::as_str);
    if let Some(about) = word("about") {
        return about.to_owned();
    }
    let differences = keys(own)
        .into_iter()
        .filter(|(key, _)| !["base", "environment", "dataset"].contains(&key.as_str()))
        .map(|(key, value)| format!("{} {value}", key.trim_start_matches("agent.")));
    format!("{}: {}", word("base").unwrap_or_default(), differences.collect::<Vec<_>>().join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_changes_what_it_names_and_nothing_else() {
        let mut table = toml::toml! { a = 1.5 b = [1, 2] [c] d = 1 e = "x" };
        merge(&mut table, toml::toml! { a = 2 b = [3] [c] e = "y" f = true });
        assert_eq!(table, toml::toml! { a = 2.0 b = [3] [c] d = 1 e = "y" f = true });
    }

    #[test]
    fn assignments_are_toml_and_words_need_no_quotes() {
        assert_eq!(parse_assignment("agent.tau=0.5").unwrap(), toml::toml! { agent.tau = 0.5 });
        assert_eq!(parse_assignment("agent.eta.initial = 1").unwrap(), toml::toml! { agent.eta.initial = 1 });
        assert_eq!(parse_assignment("environment=my-robot").unwrap(), toml::toml! { environment = "my-robot" });
        assert_eq!(parse_assignment("dataset=a b/c=\"d\".hdf5").unwrap()["dataset"].as_str(), Some("a b/c=\"d\".hdf5"));
        assert!(parse_assignment("agent.tau").unwrap_err().contains("KEY=VALUE"));
        assert!(parse_assignment("agent tau=1").unwrap_err().contains("agent tau"));
    }

    #[test]
    fn what_is_misspelt_is_answered_with_the_nearest() {
        assert_eq!(nearest("walker2d-medium-replay", names())[0], "walker2d-medium-replay-v2");
        assert_eq!(nearest("hoper-demo", names())[0], "hopper-demo");
        assert_eq!(nearest("tua", ["agent.rho", "agent.tau"]), ["agent.tau"]);
        assert!(nearest("walker", names()).contains(&"walker2d-demo"));
        assert!(nearest("zzz", names()).is_empty());
        let mut table = load("hopper-demo").unwrap();
        assert_eq!(unknown_key(&table), None);
        merge(&mut table, toml::toml! { tau = 1 });
        assert_eq!(unknown_key(&table).unwrap(), ("tau".to_owned(), vec!["agent.tau".to_owned()]));
    }

    #[test]
    fn every_file_of_the_folder_is_embedded() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../presets");
        let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|file| file.unwrap().file_name()).collect();
        let mut embedded: Vec<std::ffi::OsString> = names().map(|name| format!("{name}.toml").into()).collect();
        files.sort();
        embedded.sort();
        assert_eq!(files, embedded);
    }
}
