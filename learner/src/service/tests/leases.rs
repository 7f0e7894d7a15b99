//! Tests of leases.

use super::*;

#[test]
fn the_more_evaluators_the_less_often_each_reports_progress() {
    for (present, expected) in [(0, 1000), (25, 1000), (50, 2000), (400, 16_000), (1000, 20_000)] {
        let mut bench = Bench::empty(7);
        bench.open_evaluation(1000);
        bench.connect(present);
        assert_eq!(bench.job("a", 0).progress_milliseconds, expected, "{present}");
        let lease = LEASE.as_secs().max(3 * expected / 1000);
        assert_eq!([lease - 1, lease].map(|seconds| bench.expire(seconds)), [0, 1]);
    }
}

/// An evaluator has a minute to fetch the weights.
#[test]
fn progress_that_advances_extends_the_lease_of_its_job_only() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in (5..60).step_by(5) {
        assert_eq!(bench.progress(&progress(&job, "a", 0), seconds), None);
        assert_eq!(bench.progress(&progress(&other, "b", seconds), seconds), None);
    }
    for (steps_done, episodes_done) in [(55, 0), (54, 0), (0, 0)] {
        let message = Progress { episodes_done, ..progress(&other, "b", steps_done) };
        assert_eq!(bench.progress(&message, 59), Some("not_advanced"));
    }
    let message = Progress { episodes_done: 1, ..progress(&other, "b", 55) };
    assert_eq!(bench.progress(&message, 59), None);
    assert_eq!([59, 60, 68, 69].map(|seconds| bench.expire(seconds)), [0, 1, 0, 1]);
}

#[test]
fn progress_of_others_is_refused_and_extends_nothing() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.job("b", 0);
    let refusals: [(fn(&mut Progress), _); 4] = [
        (|progress| progress.evaluator = name("b"), "unknown_job"),
        (|progress| progress.job = 99, "unknown_job"),
        (|progress| progress.run = name("other"), "unknown_run"),
        (|progress| progress.incarnation = 1, "unknown_incarnation"),
    ];
    for (change, refusal) in refusals {
        let mut message = progress(&job, "a", 10);
        change(&mut message);
        assert_eq!(bench.progress(&message, 9), Some(refusal));
    }
    assert_eq!(bench.expire(10), 2);
}

/// While the disk is full, evaluators deliver their scores again and again.
#[test]
fn scores_that_cannot_be_saved_extend_the_lease_to_a_day_at_most() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    let longest = Job::LONGEST.as_secs();
    for seconds in (5..longest).step_by(5) {
        bench.handle(Input::Scores(0, report(&job, "a")), seconds);
        let earlier = ScoreReport { incarnation: 1, ..report(&other, "b") };
        bench.handle(Input::Scores(0, earlier), seconds);
        assert_eq!(bench.expire(seconds), usize::from(seconds == 10), "b's ends");
    }
    assert_eq!((bench.expire(longest - 1), bench.expire(longest)), (0, 1));
}

/// An evaluator that asks for another job, and works on none, has only lost the answer.
#[test]
fn two_evaluators_share_a_name_if_one_works_while_the_other_asks() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let told = |bench: &mut Bench, steps| {
        lines(bench.handle(Input::Progress(progress(&job, "a", steps)), 1))
    };
    bench.claim("a", 0, 1);
    assert!(told(&mut bench, 1).is_empty(), "the same claim once more");
    bench.claim("a", 7, 1);
    assert_eq!(
        told(&mut bench, 2),
        [
            "two evaluators were started with --name a, and one of them gets no work; give each its own name"
        ]
    );
    assert!(told(&mut bench, 3).is_empty(), "it is told once");
}
