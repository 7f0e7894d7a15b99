//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::DEFINITION;
use crate::golden::{check_definition, fresh, goldens};

#[test]
fn golden_update() {
    check_definition(&DEFINITION, goldens("iql"));
}

#[test]
fn golden_update_of_a_fresh_seed() {
    check_definition(&DEFINITION, fresh("iql").into_iter().collect());
}
