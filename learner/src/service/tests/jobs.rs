//! Tests of the jobs that are handed out.

use super::*;

#[test]
fn jobs_go_out_oldest_step_first_and_no_episode_twice() {
    let mut bench = Bench::new();
    let jobs = ["a", "b", "c", "d"].map(|evaluator| bench.job(evaluator, 0));
    let seeds: [&[u64]; 4] = [&[1, 2, 3, 4, 5], &[6, 7], &[11, 12, 13, 14, 15], &[16, 17]];
    for ((job, step), seeds) in jobs.iter().zip([1000, 1000, 2000, 2000]).zip(seeds) {
        assert_eq!((job.step, &job.seeds[..]), (step, seeds));
        assert_eq!(job.weights, hash(step));
        assert_eq!((job.incarnation, job.environment_seed), (INCARNATION, 5));
    }
    assert!(matches!(bench.claim("e", 0, 0), Claimed::Wait(_)));
    assert_eq!(bench.board.pending(), 14);
}

#[test]
fn an_evaluator_without_the_environment_gets_nothing() {
    let (mut bench, evaluator) = (Bench::new(), &name("a"));
    let claim = Claim { evaluator, attempt: 1, fits: false, present: 0 };
    assert!(matches!(bench.board.claim(claim, bench.start), Claimed::Wait(_)));
}

#[test]
fn a_repeated_claim_gets_the_same_job_and_another_claim_waits() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let seeds = job.seeds.clone();
    assert_eq!(bench.claim("a", 0, 3), Claimed::Job { job, again: true });
    assert!(matches!(bench.claim("a", 1, 3), Claimed::Wait(_)), "one job at a time");
    assert_eq!(bench.job("b", 3).seeds, [6, 7]);
    assert_eq!(bench.expire(10), 1, "a claim does not extend the lease");
    assert_eq!(bench.job("a", 10).seeds, seeds);
}

/// An evaluator that asks for another job, and works on none, has only lost the answer.
#[test]
fn two_evaluators_share_a_name_if_one_works_while_the_other_asks() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    assert_eq!(bench.progress(&progress(&job, "a", 1), 1), Ok(false));
    bench.claim("a", 0, 2);
    let message = progress(&job, "a", 2);
    assert_eq!(bench.progress(&message, 2), Ok(false), "the same claim once more");
    bench.claim("a", 7, 3);
    assert_eq!(bench.progress(&message, 3), Err(Refusal::NotAdvanced));
    assert_eq!(bench.progress(&progress(&job, "a", 3), 4), Ok(true));
    bench.deliver(&full_report(&job, "a")).unwrap();
    let next = bench.job("a", 5);
    assert_eq!(bench.progress(&progress(&next, "a", 1), 6), Ok(false));
}

#[test]
fn the_more_evaluators_the_less_often_each_reports_progress() {
    for (present, expected) in [(0, 1000), (25, 1000), (50, 2000), (400, 16_000), (1000, 20_000)] {
        let mut bench = Bench::new();
        bench.present = present;
        assert_eq!(bench.job("a", 0).progress_milliseconds, expected, "{present}");
        let lease = LEASE.as_secs().max(3 * expected / 1000);
        assert_eq!([lease - 1, lease].map(|seconds| bench.expire(seconds)), [0, 1]);
    }
}

#[test]
fn jobs_are_larger_when_more_episodes_wait() {
    let mut bench = Bench::new();
    let seeds = Vec::from_iter(100..200);
    bench.board.add_evaluation(500, hash(500), &seeds).unwrap();
    // Half of a share of 114 episodes, of 100, of 88.
    for (present, sizes) in [(1, [20; 3]), (4, [14, 12, 11]), (11, [5; 3])] {
        bench.present = present;
        let jobs = ["a", "b", "c"].map(|evaluator| (evaluator, bench.job(evaluator, 0)));
        for (evaluator, job) in &jobs {
            bench.hand_back(evaluator, job, None).unwrap();
        }
        assert_eq!(jobs.map(|(_, job)| job.seeds.len()), sizes);
    }

    // One of the episodes may have crashed the lost evaluator.
    bench.present = 1;
    assert_eq!(bench.job("a", 0).seeds.len(), 20);
    bench.leave("a", 0);
    let sizes = ["b", "c", "d", "e", "f"].map(|name| bench.job(name, 0).seeds.len());
    assert_eq!(sizes, [5, 5, 5, 5, 20]);
}

#[test]
fn an_evaluator_that_leaves_loses_its_job_and_no_other() {
    let mut bench = Bench::new();
    let (first, other) = (bench.job("a", 0), bench.job("b", 0));
    assert_eq!([bench.leave("a", 0), bench.leave("a", 0)].map(|lost| lost.jobs), [1, 0]);
    assert_eq!(bench.job("c", 0).seeds, first.seeds);
    assert_eq!(bench.deliver(&full_report(&other, "b")), Ok((2, 0, 1)));
}

#[test]
fn only_the_evaluator_that_has_a_job_hands_it_back() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let unknown = Job { id: job.id + 1, ..job.clone() };
    assert_eq!(bench.hand_back("b", &job, None), None);
    assert_eq!(bench.hand_back("a", &unknown, None), None);
    assert_eq!(bench.job("b", 0).seeds, [6, 7]);
    assert_eq!(bench.hand_back("a", &job, None), Some((1000, vec![])));
    assert_eq!(bench.hand_back("a", &job, None), None, "only once");
    assert_eq!(bench.job("c", 0).seeds, job.seeds);
}

#[test]
fn episodes_that_crash_every_evaluator_are_given_up() {
    let mut bench = Bench::new();
    for _ in 0..100 {
        let job = bench.job("a", 0);
        bench.hand_back("a", &job, None).expect("a leaving evaluator does not count");
    }
    let mut given_up = Vec::new();
    // An episode rests for a minute at most.
    for minute in 1..=20 {
        assert!(given_up.is_empty(), "minute {minute}");
        assert_eq!(bench.job("a", 60 * minute).seeds, [1, 2, 3, 4, 5]);
        given_up = bench.leave("a", 60 * minute).given_up;
    }
    let expected = [1, 2, 3, 4, 5].map(|seed| (1000, seed));
    assert_eq!((&given_up[..], &bench.board.missing()[..]), (&expected[..], &expected[..]));
    assert_eq!(bench.board.pending(), 9, "the run does not wait for them");
    let next = bench.job("a", 0);
    assert_eq!(next.seeds, [6, 7]);
    let late = report(&next, "b", vec![score(1, 0.0)]);
    assert_eq!(bench.deliver(&late), Ok((1, 0, 0)), "late scores still count");
    assert_eq!(bench.board.missing(), expected[1..]);
}

/// A restarted container crashes under another name each time; a snapshot that cannot be read fails
/// for every evaluator.
#[test]
fn an_episode_that_keeps_failing_is_given_up_after_some_minutes() {
    for hands_back in [false, true] {
        let (mut bench, mut seconds) = (Bench::new(), 0);
        while bench.board.missing().is_empty() {
            seconds += 1;
            let evaluator = format!("crash-{seconds}");
            if let Claimed::Job { job, .. } = bench.claim(&evaluator, 1, seconds) {
                match hands_back {
                    true => drop(bench.hand_back(&evaluator, &job, Some(seconds)).unwrap()),
                    false => drop(bench.leave(&evaluator, seconds)),
                }
            }
        }
        assert!((600..1200).contains(&seconds), "given up after {seconds} s");
    }
}

#[test]
fn a_machine_that_keeps_failing_does_not_keep_others_from_the_end() {
    let mut bench = Bench::new();
    for seconds in 1..600 {
        let crash = format!("crash-{seconds}");
        if let Claimed::Job { .. } = bench.claim(&crash, 1, seconds) {
            bench.leave(&crash, seconds);
        }
        // It asks just as often, but is not the first.
        if let Claimed::Job { job, .. } = bench.claim("works", seconds, seconds) {
            bench.deliver(&full_report(&job, "works")).unwrap();
        }
    }
    assert_eq!((bench.board.pending(), bench.board.missing()), (0, vec![]));
}

#[test]
fn scores_of_an_earlier_incarnation_count_unless_the_weights_differ() {
    let saved = |step, episodes| {
        let weights = hash(step).to_string();
        (step, SavedScores { weights, episodes })
    };
    let part = saved(3000, vec![score(22, 400.0)]);
    let whole = saved(4000, vec![score(32, 1.0), score(31, 2.0)]);
    let mut bench = Bench::after([part, whole].into());
    let pending = bench.board.pending();
    assert_eq!(bench.board.add_evaluation(3000, hash(3000), &[21, 22, 23]), Ok(None));
    assert_eq!(bench.board.pending(), pending + 2);
    let complete = bench.board.add_evaluation(4000, hash(4000), &[31, 32]);
    assert_eq!(complete, Ok(Some(vec![score(31, 2.0), score(32, 1.0)])));
    assert_eq!(bench.board.add_evaluation(4000, hash(4000), &[31, 32]), Ok(None), "again");
    let error = bench.board.add_evaluation(3000, hash(1), &[21, 22, 23]).unwrap_err();
    let scored = hash(3000).to_string();
    assert_eq!(error, OtherWeights { step: 3000, found: hash(1), scored });
}
