//! Tests of leases.

use super::*;

#[test]
fn an_expired_lease_frees_the_unscored_episodes() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.deliver(&report(&lost, "a", vec![score(2, 0.0)])).unwrap();
    assert_eq!([9, 10, 10].map(|seconds| bench.expire(seconds)), [0, 1, 0]);
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
    for steps in [100, 99, 0] {
        let message = progress(&job, "a", steps);
        assert_eq!(bench.progress(&message, 9), Err(Refusal::NotAdvanced));
    }
    let ended = Progress { episodes_done: 1, ..progress(&job, "a", 100) };
    bench.progress(&ended, 14).unwrap();
    assert_eq!([23, 24].map(|seconds| bench.expire(seconds)), [0, 1]);
}

#[test]
fn an_evaluator_has_a_minute_to_fetch_the_weights() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in (5..60).step_by(5) {
        bench.progress(&progress(&job, "a", 0), seconds).unwrap();
        bench.progress(&progress(&other, "b", 0), seconds).unwrap();
    }
    bench.progress(&progress(&other, "b", 1), 59).unwrap();
    bench.progress(&progress(&job, "a", 0), 59).unwrap();
    // The job of a, which has not begun, ends before that of b.
    assert_eq!([59, 60, 68, 69].map(|seconds| bench.expire(seconds)), [0, 1, 0, 1]);
}

/// While the disk is full, evaluators deliver their scores again and again.
#[test]
fn scores_that_cannot_be_saved_extend_the_lease() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    let good = full_report(&job, "a");
    for seconds in (5..60).step_by(5) {
        bench.extend_lease(&good, seconds);
        bench.extend_lease(&ScoreReport { incarnation: 1, ..full_report(&other, "b") }, seconds);
        bench.extend_lease(&ScoreReport { evaluator: name("b"), ..good.clone() }, seconds);
    }
    // Nothing was delivered for the job of b; a has stopped delivering.
    assert_eq!([9, 10, 64, 65].map(|seconds| bench.expire(seconds)), [0, 1, 0, 1]);
    let job = bench.job("a", 70);
    let longest = 70 + Job::LONGEST.as_secs();
    (75..longest)
        .step_by(5)
        .for_each(|seconds| bench.extend_lease(&full_report(&job, "a"), seconds));
    assert_eq!((bench.expire(longest - 1), bench.expire(longest)), (0, 1));
}

#[test]
fn progress_of_others_is_refused_and_extends_nothing() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.job("b", 0);
    let good = progress(&job, "a", 10);
    let wrong = |change: fn(&mut Progress)| {
        let mut message = good.clone();
        change(&mut message);
        message
    };
    for (message, refusal) in [
        (wrong(|message| message.evaluator = name("b")), Refusal::Job),
        (wrong(|message| message.job = 99), Refusal::Job),
        (wrong(|message| message.run = name("other")), Refusal::Run),
        (wrong(|message| message.incarnation = 1), Refusal::Incarnation),
    ] {
        assert_eq!(bench.progress(&message, 9), Err(refusal));
    }
    assert_eq!(bench.expire(10), 2);
}
