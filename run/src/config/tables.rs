//! Operations on TOML tables.

pub use quad_algorithms::merge;
use toml::{Table, Value};

/// Parses `agent.tau=0.5`: a dotted key and a TOML value, in which text needs no quotes.
pub fn parse_assignment(text: &str) -> Result<Table, String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE")?;
    let quoted = || format!("{key} = {}", Value::String(value.trim().to_owned()));
    text.parse().or_else(|_| quoted().parse()).map_err(|_| format!("{key:?} is no key"))
}

/// The values of a table and its inner tables, with dotted keys.
pub fn keys(table: &Table) -> Vec<(String, &Value)> {
    let mut values = Vec::new();
    for (key, value) in table {
        match value {
            Value::Table(inner) => {
                let dotted = |(rest, value)| (format!("{key}.{rest}"), value);
                values.extend(keys(inner).into_iter().map(dotted));
            }
            value => values.push((key.clone(), value)),
        }
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_assignments() {
        for (text, expected) in [
            ("agent.tau=0.5", "agent.tau = 0.5"),
            ("environment=my-robot", "environment = 'my-robot'"),
            ("dataset=a b/c=\"d\".hdf5", "dataset = 'a b/c=\"d\".hdf5'"),
        ] {
            assert_eq!(parse_assignment(text), Ok(expected.parse().unwrap()));
        }
        assert!(parse_assignment("agent tau=1").unwrap_err().contains("agent tau"));
    }
}
