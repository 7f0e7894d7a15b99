//! A run that plans more than any memory holds: it is to go on until its user stops it.

use serde_json::{Value, json};

use crate::bounded;
use crate::run::Run;

#[test]
fn looking_at_it_costs_no_more_than_looking_at_what_it_has() {
    let folder = tempfile::tempdir().unwrap();
    let [steps, eval_interval, episodes] =
        [1_000_000_000_000_000i64, 1, 1000].map(toml::Value::from);
    let mut run = Run::new("hopper-demo", 0).set(&[
        ("experiment.steps", steps),
        ("experiment.eval_interval", eval_interval),
        ("experiment.episodes", episodes),
    ]);
    (0..1000).for_each(|seed| run.score(1, seed, 5.0, "00"));
    run.write(folder.path());
    let look = |arguments: &[&str]| {
        let output = bounded(&[arguments, &[folder.path().to_str().unwrap()]].concat());
        String::from_utf8(output.stdout).unwrap()
    };
    let report: Value = serde_json::from_str(&look(&["report", "--json"])).unwrap();
    assert_eq!(report["runs"][0]["episodes_missing"], json!(999_999_999_999_999_000i64));
    assert!(look(&["report"]).contains("1 of 1000000000000000 evaluations are complete"));
    assert!(look(&["list"]).contains("5.0 @1"));
    let found = look(&["verify"]);
    assert!(found.contains("without a score (1000000000000000000): step 1, seed "), "{found}");
}
