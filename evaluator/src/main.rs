//! `evaluator`: see `evaluator --help`.
fn main() {}
