//! Tests: the update against an independent implementation (tests/golden/README.md).

use super::DEFINITION;
use crate::golden::{check_definition, golden_tests};

golden_tests!("iql", |golden, device| check_definition(&DEFINITION, golden, device));
