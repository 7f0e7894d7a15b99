//! Which combinations of a study's axes are runs.

use quad_algorithms::fits;
use quad_run::config::tables;
use toml::{Table, Value};

use super::axes::Combination;

/// What a study says of combinations. A rule has a value, or a list of values, for some axes; `*`
/// stands for any letters.
pub(super) struct Rules<'a> {
    /// If there are any, only combinations that fit one of them are runs.
    pub only: &'a [Table],
    /// Combinations that fit one of them are none.
    pub except: &'a [Table],
}

impl Rules<'_> {
    /// Whether a combination is a run.
    pub fn allow(&self, combination: &Combination<'_>) -> bool {
        let fits_any = |rules: &[Table]| rules.iter().any(|rule| all_fit(rule, combination));
        (self.only.is_empty() || fits_any(self.only)) && !fits_any(self.except)
    }

    /// What is wrong with them: a key that is no axis, a rule that no combination fits.
    pub fn wrong(&self, combinations: &[Combination<'_>]) -> Vec<String> {
        let named = |name: &'static str, rules: &'_ [Table]| {
            let wrong = |rule| Some(format!("a rule [[{name}]] {}", wrong(rule, combinations)?));
            rules.iter().filter_map(wrong).collect::<Vec<_>>()
        };
        [named("only", self.only), named("except", self.except)].concat()
    }
}

/// The values of axes that the command line keeps to: of each axis that it names, one of those that
/// it gives.
pub(super) struct Narrower(Table);

impl Narrower {
    pub fn new(only: &[Table]) -> Self {
        let mut values = Table::new();
        for (key, value) in only.iter().flat_map(tables::keys) {
            if let Value::Array(several) =
                values.entry(key).or_insert_with(|| Value::Array(Vec::new()))
            {
                several.push(value.clone());
            }
        }
        Self(values)
    }

    pub fn allows(&self, combination: &Combination<'_>) -> bool {
        all_fit(&self.0, combination)
    }

    pub fn wrong(&self, combinations: &[Combination<'_>]) -> Vec<String> {
        wrong(&self.0, combinations).map(|wrong| format!("--only {wrong}")).into_iter().collect()
    }
}

fn wrong(rule: &Table, combinations: &[Combination<'_>]) -> Option<String> {
    let axes: Vec<&str> = combinations.first().into_iter().flatten().map(|(key, _)| *key).collect();
    if let Some((key, _)) = tables::keys(rule).iter().find(|(key, _)| !axes.contains(&&**key)) {
        return Some(format!("names {key}, which is no axis; there are {}", axes.join(", ")));
    }
    let text = rule.to_string();
    let rule_fits = combinations.iter().any(|combination| all_fit(rule, combination));
    (!rule_fits).then(|| format!("fits no combination: {}", text.trim().replace('\n', ", ")))
}

fn all_fit(rule: &Table, combination: &Combination<'_>) -> bool {
    let value =
        |key: &str| combination.iter().find(|(axis, _)| *axis == key).map(|(_, value)| *value);
    tables::keys(rule).iter().all(|(key, wanted)| value(key).is_some_and(|value| is(value, wanted)))
}

fn is(value: &Value, wanted: &Value) -> bool {
    match (value, wanted) {
        (value, Value::Array(several)) => several.iter().any(|wanted| is(value, wanted)),
        (Value::String(value), Value::String(pattern)) => fits(pattern, value),
        (Value::Float(value), Value::Integer(wanted)) => *value == *wanted as f64,
        (value, wanted) => value == wanted,
    }
}
