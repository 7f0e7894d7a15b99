//! Tests of `config/tables.rs`.

use super::*;

#[test]
fn assignments_are_toml_and_words_need_no_quotes() {
    assert_eq!(parse_assignment("agent.tau=0.5").unwrap(), toml::toml! { agent.tau = 0.5 });
    assert_eq!(
        parse_assignment("environment=my-robot").unwrap(),
        toml::toml! { environment = "my-robot" }
    );
    assert_eq!(
        parse_assignment("dataset=a b/c=\"d\".hdf5").unwrap()["dataset"].as_str(),
        Some("a b/c=\"d\".hdf5")
    );
    assert!(parse_assignment("agent.tau").unwrap_err().contains("KEY=VALUE"));
    assert!(parse_assignment("agent tau=1").unwrap_err().contains("agent tau"));
}
