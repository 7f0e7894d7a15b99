//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::DEFINITION;
use crate::golden::{check_definition, fresh, goldens};

#[test]
fn golden_update() {
    check_definition(&DEFINITION, goldens("ivr"));
}

#[test]
fn golden_update_of_a_fresh_seed() {
    check_definition(&DEFINITION, ["sql", "eql"].into_iter().filter_map(fresh).collect());
}
