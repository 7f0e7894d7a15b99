//! Tests of the jobs that are handed out.

use super::*;

#[test]
fn an_evaluator_without_work_asks_again_the_later_the_more_there_are() {
    let pause = |bench: &mut Bench| match bench.claim("a", 0, 0) {
        JobReply::Wait { milliseconds, .. } => milliseconds,
        reply => panic!("{reply:?}"),
    };
    for (present, idle, between) in [(0, 500, 100), (1, 500, 100), (8, 800, 160)] {
        let mut bench = Bench::empty(7);
        bench.connect(present);
        assert_eq!(pause(&mut bench), idle);
        bench.open_online(0);
        bench.job("b", 0);
        assert_eq!(pause(&mut bench), 20 * present.max(1) as u64, "an online episode is played");
        results::deliver_episode(&mut bench);
        assert_eq!(pause(&mut bench), between, "another will be open soon");
        bench.handle(Input::Trained, 0);
        assert_eq!(pause(&mut bench), idle);
    }
    let environments = vec!["walker2d".to_owned()];
    let claim = JobRequest::Claim { evaluator: name("a"), attempt: 1, environments };
    let wait = JobReply::Wait { incarnation: INCARNATION, milliseconds: 10_000 };
    assert_eq!(Bench::new().ask(claim, 0), wait, "it has another environment");
}

#[test]
fn a_repeated_claim_gets_the_same_job_and_another_claim_waits() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    assert_eq!(bench.claim("a", 0, 3), JobReply::Job(job.clone()));
    assert!(matches!(bench.claim("a", 1, 3), JobReply::Wait { .. }), "one job at a time");
    assert!(!bench.hand_back("b", job.id, None, 3), "it is a's");
    assert!(!bench.hand_back("a", job.id + 1, None, 3));
    assert!(bench.hand_back("a", job.id, None, 3));
    assert!(!bench.hand_back("a", job.id, None, 3), "only once");
    assert_eq!(bench.job("b", 3).seeds, job.seeds);
}

#[test]
fn jobs_are_larger_when_more_episodes_wait() {
    // Half of a share of 100 episodes, of 80, of 60.
    for (present, sizes) in [(1, [20; 3]), (4, [12, 11, 9]), (11, [5; 3])] {
        let mut bench = Bench::empty(100);
        bench.open_evaluation(1000);
        bench.connect(present);
        assert_eq!(["a", "b", "c"].map(|evaluator| bench.job(evaluator, 0).seeds.len()), sizes);
    }
    // One of the episodes may have crashed the lost evaluator.
    let mut bench = Bench::empty(100);
    bench.open_evaluation(1000);
    assert_eq!(bench.job("a", 0).seeds.len(), 20);
    bench.handle(Input::Left(name("a")), 0);
    let sizes = ["b", "c", "d", "e", "f"].map(|evaluator| bench.job(evaluator, 0).seeds.len());
    assert_eq!(sizes, [5, 5, 5, 5, 20]);
}

/// A restarted container crashes under another name each time; a snapshot that cannot be read fails
/// for every evaluator.
#[test]
fn episodes_that_keep_failing_are_given_up_after_some_minutes() {
    for hands_back in [false, true] {
        let mut bench = Bench::new();
        let first = bench.job("a", 0);
        for id in first.id..first.id + 100 {
            assert!(bench.hand_back("a", id, None, 0), "one that leaves does not count");
            bench.job("a", 0);
        }
        bench.handle(Input::Left(name("a")), 0);
        let (mut seconds, mut told) = (0, Vec::new());
        while bench.service.gauges().missing == 0 {
            seconds += 1;
            let evaluator = format!("crash-{seconds}");
            let JobReply::Job(job) = bench.claim(&evaluator, 1, seconds) else { continue };
            let evaluator = name(&evaluator);
            let failed = Some("a\u{7}".repeat(400));
            let hand_back =
                JobRequest::HandBack { evaluator: evaluator.clone(), job: job.id, failed };
            let input = if hands_back { Input::Job(0, hand_back) } else { Input::Left(evaluator) };
            told.extend(lines(bench.handle(input, seconds)));
        }
        assert!((600..1200).contains(&seconds), "given up after {seconds} s");
        let given_up = told.pop().unwrap();
        assert_eq!(given_up, "5 episodes given up: too many evaluators were lost or failed");
        let reason = "a".repeat(300);
        let failed = |step: u64, number: u64| {
            format!(
                "evaluator crash-{number} could not do a job of step {step}, which goes to others: {reason}"
            )
        };
        assert_eq!(told.contains(&failed(1000, 1)), hands_back);
        assert!(told.len() <= 2, "once for each step: {told:?}");
        assert_eq!(bench.pending(), 9, "the run does not wait for them");

        let late =
            ScoreReport { episodes: vec![score(first.seeds[0], 0.0)], ..report(&first, "a") };
        bench.deliver(late);
        assert_eq!(bench.service.gauges().missing, 4, "late scores still count");
    }
}

#[test]
fn a_machine_that_keeps_failing_does_not_keep_others_from_the_end() {
    let mut bench = Bench::new();
    for seconds in 1..600 {
        let crash = format!("crash-{seconds}");
        bench.claim(&crash, 1, seconds);
        bench.handle(Input::Left(name(&crash)), seconds);
        // It asks just as often, but is not the first.
        if let JobReply::Job(job) = bench.claim("works", seconds, seconds) {
            bench.deliver(report(&job, "works"));
        }
    }
    assert_eq!((bench.pending(), bench.service.gauges().missing), (0, 0));
}

#[test]
fn an_online_episode_for_which_training_has_waited_goes_to_a_second_evaluator() {
    let mut bench = Bench::new();
    (0..2).for_each(|episode| bench.open_online(episode));
    let slow = bench.job("slow", 0);
    assert_eq!((&slow.seeds[..], slow.step, slow.weights), (&[100][..], 500, hash(500)));
    assert_eq!(bench.job("other", 0).seeds, [101]);
    bench.handle(Input::Waits(0), 100);
    bench.progress(&progress(&slow, "slow", 5), 119);
    assert_eq!(bench.job("a", 119).exploration, None);
    let second = bench.job("b", 120);
    assert_eq!((&second.seeds, second.exploration), (&slow.seeds, slow.exploration));
    assert_eq!(bench.job("c", 120).exploration, None, "two are enough");
    for seconds in 120..124 {
        let second = bench.job("b", seconds);
        assert!(bench.hand_back("b", second.id, Some("it fails"), seconds));
    }
    assert_eq!(bench.job("d", 124).exploration, None, "it rests, although one still plays it");
}
