//! Tests: the update, which is AlignIQL's, and the choice against an independent implementation
//! (tests/golden/README.md).

use crate::align_iql::golden::check;
use crate::golden::golden_tests;

golden_tests!("idql", check);
