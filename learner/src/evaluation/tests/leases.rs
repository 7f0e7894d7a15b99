//! For how long an evaluator keeps a job.

use super::*;

#[test]
fn a_lease_that_runs_out_gives_the_unscored_episodes_to_the_next() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.deliver(&report(&lost, "a", vec![score(2, 0.0)])).unwrap();
    assert_eq!(
        [bench.expire(9), bench.expire(10), bench.expire(10)],
        [0, 1, 0],
        "in time, and only once"
    );
    let next = bench.job("b", 10);
    assert_eq!((next.step, next.seeds), (1000, vec![1, 3, 4, 5, 6]));
    assert_ne!(next.id, lost.id);
}

#[test]
fn progress_extends_the_lease_of_its_job_only() {
    let mut bench = Bench::new();
    let (alive, lost) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in [5, 14, 23] {
        bench.progress(&progress(&alive, "a", seconds), seconds).unwrap();
    }
    assert_eq!(bench.expire(24), 1);
    let next = bench.job("c", 24);
    assert_eq!(next.seeds, lost.seeds);
    assert_eq!(bench.expire(33), 1, "10 s after the last progress");
}

#[test]
fn progress_that_does_not_advance_extends_nothing() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let first = progress(&job, "a", 100);
    bench.progress(&first, 5).unwrap();
    assert_eq!(bench.progress(&first, 9), Err(Refusal::NotAdvanced), "the same once more");
    assert_eq!(bench.progress(&progress(&job, "a", 99), 9), Err(Refusal::NotAdvanced));
    assert_eq!(
        bench.progress(&progress(&job, "a", 0), 9),
        Err(Refusal::NotAdvanced),
        "it has begun"
    );
    let ended = Progress { episodes_done: 1, ..progress(&job, "a", 100) };
    bench.progress(&ended, 14).unwrap();
    assert_eq!((bench.expire(23), bench.expire(24)), (0, 1));
}

/// While it fetches the weights an evaluator has nothing to show. It has a minute for that, then it
/// must begin.
#[test]
fn an_evaluator_may_prepare_for_a_while() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in (5..60).step_by(5) {
        bench.progress(&progress(&job, "a", 0), seconds).unwrap();
        bench.progress(&progress(&other, "b", 0), seconds).unwrap();
    }
    bench.progress(&progress(&other, "b", 1), 59).unwrap();
    bench.progress(&progress(&job, "a", 0), 59).unwrap();
    assert_eq!((bench.expire(59), bench.expire(60)), (0, 1), "a's, which has not begun");
    assert_eq!((bench.expire(68), bench.expire(69)), (0, 1));
}

/// The disk is full: an evaluator that has delivered its scores has done all that it can, and
/// delivers them again.
#[test]
fn scores_that_cannot_be_saved_keep_their_job() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    let good = full_report(&job, "a");
    for seconds in (5..60).step_by(5) {
        bench.keep(&good, seconds);
        bench.keep(&ScoreReport { incarnation: 1, ..full_report(&other, "b") }, seconds);
        bench.keep(&ScoreReport { evaluator: name("b"), ..good.clone() }, seconds);
    }
    assert_eq!((bench.expire(9), bench.expire(10)), (0, 1), "b's, for which nothing was delivered");
    assert_eq!((bench.expire(64), bench.expire(65)), (0, 1), "a's, which has stopped asking");
    let job = bench.job("a", 70);
    let longest = 70 + Job::LONGEST.as_secs();
    (75..longest).step_by(5).for_each(|seconds| bench.keep(&full_report(&job, "a"), seconds));
    assert_eq!((bench.expire(longest - 1), bench.expire(longest)), (0, 1));
}

#[test]
fn progress_of_others_is_refused_and_extends_nothing() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.job("b", 0);
    let cases = [
        (progress(&job, "b", 10), Refusal::Evaluator),
        (progress(&Job { id: 99, ..job.clone() }, "a", 10), Refusal::Job),
        (progress(&Job { run: name("other"), ..job.clone() }, "a", 10), Refusal::Run),
        (progress(&Job { incarnation: 1, ..job.clone() }, "a", 10), Refusal::Incarnation),
    ];
    for (message, refusal) in cases {
        assert_eq!(bench.progress(&message, 9), Err(refusal));
    }
    assert_eq!(bench.expire(10), 2);
}
