//! Tests of `config/nearest.rs`.

use super::did_you_mean;

#[test]
fn a_misspelled_name_is_answered_with_the_nearest() {
    let known = ["hopper-demo", "walker2d-demo", "walker2d-medium-v2", "walker2d-medium-replay-v2"];
    let answer = |word| did_you_mean(word, known);
    assert_eq!(answer("hoper-demo"), "did you mean hopper-demo? ");
    assert!(
        answer("walker2d-medium-reply-v2").starts_with("did you mean walker2d-medium-replay-v2")
    );
    assert!(answer("walker").contains("walker2d-demo"));
    assert_eq!(answer("zzz"), "");
}
