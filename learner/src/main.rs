//! learner
fn main() {}
