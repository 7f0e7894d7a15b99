//! Presets: TOML tables that the binary carries, each a short difference from a base.
//!
//! Besides the keys of an experiment a preset may have `base`, the name of an embedded preset that it changes key by key, and
//! `about`, a few words for the list of presets. A preset that names no environment is a base and nothing else.

use std::path::Path;

use anyhow::{Context, anyhow};
use quad_service::hinted;
use toml::{Table, Value};

use super::nearest::did_you_mean;

macro_rules! embedded {
    ($($name:literal)*) => { &[$(($name, include_str!(concat!("../../../presets/", $name, ".toml")))),*] };
}

/// Name and TOML of each, in the order in which they are listed.
const EMBEDDED: &[(&str, &str)] = embedded![
    "hopper-demo" "hopper-demo-iql" "halfcheetah-demo" "walker2d-demo" "antmaze-umaze-demo" "antmaze-medium-demo"
    "own-data"
    "hopper-medium-v2" "hopper-medium-replay-v2" "hopper-medium-expert-v2"
    "walker2d-medium-v2" "walker2d-medium-replay-v2" "walker2d-medium-expert-v2"
    "halfcheetah-medium-v2" "halfcheetah-medium-replay-v2" "halfcheetah-medium-expert-v2"
    "antmaze-umaze-v0" "antmaze-umaze-diverse-v0"
    "antmaze-medium-play-v0" "antmaze-medium-diverse-v0"
    "antmaze-large-play-v0" "antmaze-large-diverse-v0"
    "paper" "paper-locomotion" "paper-antmaze" "paper-antmaze-large"
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

/// Whether this is the path of a user's own preset rather than the name of an embedded one.
pub fn is_path(preset: &str) -> bool {
    preset.ends_with(".toml")
}

/// What to do about a name that no preset has.
pub fn unknown_hint(preset: &str) -> String {
    let nearest = did_you_mean(preset, names()).map(|nearest| nearest + " ").unwrap_or_default();
    format!("{nearest}`learner presets` lists them all; a file of your own must end in .toml")
}

/// A preset (an embedded name, or a path that ends in `.toml`) merged with the bases below it.
///
/// # Errors
/// There is no such preset or base, the file cannot be read, or it is not TOML.
pub fn load(preset: &str) -> anyhow::Result<Table> {
    let own = own(preset)?;
    let mut table = match own.get("base") {
        None => Table::new(),
        // Only embedded presets are bases, and those have no cycle, so this ends.
        Some(Value::String(base)) if !is_path(base) => load(base)?,
        Some(base) => return Err(unknown(&base.to_string())),
    };
    merge(&mut table, own);
    table.retain(|key, _| key != "base" && key != "about");
    Ok(table)
}

/// What a preset says itself, its bases left out.
fn own(preset: &str) -> anyhow::Result<Table> {
    let text = match EMBEDDED.iter().find(|(name, _)| *name == preset) {
        Some((_, text)) => (*text).to_owned(),
        None if is_path(preset) => {
            std::fs::read_to_string(preset).with_context(|| format!("cannot read the preset {preset}"))?
        }
        None => return Err(unknown(preset)),
    };
    text.parse().with_context(|| format!("preset {preset} is not TOML"))
}

fn unknown(preset: &str) -> anyhow::Error {
    hinted(anyhow!("there is no preset named {preset}"), unknown_hint(preset))
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
/// A sentence for the user who typed it.
pub fn parse_assignment(text: &str) -> Result<Table, String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE, for example agent.tau=0.5")?;
    let quoted = || format!("{key} = {}", Value::String(value.trim().to_owned()));
    text.parse().or_else(|_| quoted().parse()).map_err(|_| format!("{key:?} is no key like agent.tau"))
}

/// The values of a table and of the tables in it, with dotted keys.
pub(super) fn keys(table: &Table) -> Vec<(String, &Value)> {
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

/// Each preset that can be trained: its name, its environment, its dataset or `-`, and what is special about it.
///
/// # Errors
/// An embedded preset is broken, which a test of each excludes.
pub fn tasks() -> anyhow::Result<Vec<[String; 4]>> {
    let mut tasks = Vec::new();
    for name in names() {
        let table = load(name)?;
        let word = |key| table.get(key).and_then(Value::as_str).unwrap_or("-").to_owned();
        if table.contains_key("environment") {
            tasks.push([name.to_owned(), word("environment"), word("dataset"), special(&own(name)?)]);
        }
    }
    Ok(tasks)
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
#[path = "../../tests/unit/config/presets.rs"]
mod tests;
