//! Tests of `train/pool.rs`.

use super::*;
use rayon::prelude::*;

#[test]
fn parallel_parts_run_within_and_a_panic_comes_through() {
    let sum: u64 = run_awake(|| (0..1000_u64).into_par_iter().map(|x| x * x).sum());
    assert_eq!(sum, 332_833_500);
    let panicked = std::panic::catch_unwind(|| run_awake(|| panic!("on purpose")));
    assert!(panicked.is_err(), "the threads that look for work must end, too");
}
