//! What TOML tables are to presets and settings: laid over one another, flattened, and written on a
//! command line.

pub use quad_algorithms::merge;
use toml::{Table, Value};

/// Reads `agent.tau=0.5`: a dotted key and a value in TOML's notation, where a word needs no
/// quotes.
///
/// # Errors
/// A sentence for the user who typed it.
pub fn parse_assignment(text: &str) -> Result<Table, String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE, for example agent.tau=0.5")?;
    let quoted = || format!("{key} = {}", Value::String(value.trim().to_owned()));
    text.parse()
        .or_else(|_| quoted().parse())
        .map_err(|_| format!("{key:?} is no key like agent.tau"))
}

/// The values of a table and of the tables in it, with dotted keys.
pub fn keys(table: &Table) -> Vec<(String, &Value)> {
    let mut all = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => {
                all.extend(
                    keys(inner).into_iter().map(|(rest, value)| (format!("{key}.{rest}"), value)),
                );
            }
            value => all.push((key.clone(), value)),
        }
    }
    all
}

#[cfg(test)]
mod tests;
