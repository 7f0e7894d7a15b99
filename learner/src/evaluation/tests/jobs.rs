//! Which episodes are handed out, to whom, how often.

use super::*;

#[test]
fn jobs_go_out_oldest_step_first_and_no_episode_twice() {
    let mut bench = Bench::new();
    let jobs = ["a", "b", "c", "d"].map(|evaluator| bench.job(evaluator, 0));
    let handed_out: Vec<_> = jobs.iter().map(|job| (job.step, job.seeds.clone())).collect();
    let expected = [
        (1000, vec![1, 2, 3, 4, 5]),
        (1000, vec![6, 7]),
        (2000, vec![11, 12, 13, 14, 15]),
        (2000, vec![16, 17]),
    ];
    assert_eq!(handed_out, expected);
    assert_eq!((jobs[0].weights, jobs[2].weights), (hash(1000), hash(2000)));
    assert_eq!((jobs[0].incarnation, jobs[0].environment_seed), (INCARNATION, 5));
    assert!(matches!(bench.claim("e", 0, 0), Claimed::Wait(_)));
    assert_eq!(bench.board.pending(), 14);
}

#[test]
fn an_evaluator_without_the_environment_gets_nothing() {
    let mut bench = Bench::new();
    for environments in [vec![], vec!["ant".to_owned()]] {
        let now = bench.at(0);
        let claim =
            Claim { evaluator: &name("a"), attempt: 1, environments: &environments, present: 0 };
        assert!(matches!(bench.board.claim(claim, now), Claimed::Wait(_)));
    }
}

#[test]
fn a_claim_that_is_repeated_gets_the_same_job_and_another_one_waits() {
    let mut bench = Bench::new();
    let first = bench.job("a", 0);
    let again = Claimed::Job { job: first.clone(), again: true };
    assert_eq!(bench.claim("a", 0, 3), again, "the answer was lost");
    let other = bench.claim("a", 1, 3);
    assert!(matches!(other, Claimed::Wait(_)), "one job at a time: {other:?}");
    assert_eq!(bench.job("b", 3).seeds, [6, 7]);
    assert_eq!(bench.expire(10), 1, "to ask again does not extend the lease");
    assert_eq!(bench.job("a", 10).seeds, first.seeds);
}

/// One of them works and the other asks. An evaluator that asks for another job, and works on none,
/// has only lost word of it.
#[test]
fn two_of_one_name_are_known_by_what_both_do() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    assert_eq!(bench.progress(&progress(&job, "a", 1), 1), Ok(false));
    bench.claim("a", 0, 2);
    assert_eq!(bench.progress(&progress(&job, "a", 2), 2), Ok(false), "the same claim once more");
    bench.claim("a", 7, 3);
    assert_eq!(
        bench.progress(&progress(&job, "a", 2), 3),
        Err(Refusal::NotAdvanced),
        "it does not work"
    );
    assert_eq!(bench.progress(&progress(&job, "a", 3), 4), Ok(true));
    bench.deliver(&full_report(&job, "a")).unwrap();
    let next = bench.job("a", 5);
    assert_eq!(bench.progress(&progress(&next, "a", 1), 6), Ok(false));
}

#[test]
fn the_more_there_are_the_less_often_each_tells_its_progress() {
    for (present, expected) in [(0, 1000), (25, 1000), (50, 2000), (400, 16_000), (1000, 20_000)] {
        let mut bench = Bench::new();
        bench.present = present;
        let job = bench.job("a", 0);
        assert_eq!(job.progress_milliseconds, expected, "{present}");
        let lease = LEASE.as_secs().max(3 * expected / 1000);
        assert_eq!((bench.expire(lease - 1), bench.expire(lease)), (0, 1), "a message may be lost");
    }
}

#[test]
fn the_more_episodes_wait_the_more_are_in_a_job() {
    let mut bench = Bench::new();
    bench.board.add_evaluation(500, hash(500), &Vec::from_iter(100..200)).unwrap();
    let sizes = |bench: &mut Bench, present: usize| {
        bench.present = present;
        let jobs = ["a", "b", "c"].map(|evaluator| bench.job(evaluator, 0));
        for (evaluator, job) in ["a", "b", "c"].iter().zip(&jobs) {
            assert!(bench.hand_back(evaluator, job, None).is_some());
        }
        jobs.map(|job| job.seeds.len())
    };
    assert_eq!(sizes(&mut bench, 1), [20; 3], "never more than these");
    assert_eq!(
        sizes(&mut bench, 4),
        [14, 12, 11],
        "half of a share of the 114, of the 100 that are left, …"
    );
    assert_eq!(sizes(&mut bench, 11), [5; 3]);

    // An evaluator that is lost may have been lost of one of them.
    bench.present = 1;
    assert_eq!(bench.job("a", 0).seeds.len(), 20);
    bench.gone("a", 0);
    assert_eq!(
        ["b", "c", "d", "e", "f"].map(|evaluator| bench.job(evaluator, 0).seeds.len()),
        [5, 5, 5, 5, 20]
    );
}

#[test]
fn an_evaluator_that_goes_loses_its_job_and_no_other_one() {
    let mut bench = Bench::new();
    let (first, other) = (bench.job("a", 0), bench.job("b", 0));
    assert_eq!(bench.gone("a", 0), Lost { jobs: 1, given_up: vec![] });
    assert_eq!(bench.gone("a", 0), Lost::default());
    assert_eq!(bench.job("c", 0).seeds, first.seeds);
    assert_eq!(bench.deliver(&full_report(&other, "b")).unwrap().1.jobs_completed, 1);
}

#[test]
fn only_the_evaluator_that_has_a_job_hands_it_back() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    assert_eq!(bench.hand_back("b", &job, None), None);
    assert_eq!(bench.hand_back("a", &Job { id: job.id + 1, ..job.clone() }, None), None);
    assert_eq!(bench.job("b", 0).seeds, [6, 7]);
    assert_eq!(bench.hand_back("a", &job, None), Some(HandedBack { step: 1000, given_up: vec![] }));
    assert_eq!(bench.hand_back("a", &job, None), None, "only once");
    assert_eq!(bench.job("c", 0).seeds, job.seeds);
}

#[test]
fn episodes_that_take_every_evaluator_with_them_are_given_up() {
    let mut bench = Bench::new();
    for _ in 0..100 {
        let job = bench.job("a", 0);
        assert!(bench.hand_back("a", &job, None).is_some(), "this does not count");
    }
    let mut given_up = Vec::new();
    for attempt in 1..=20 {
        // As late as the episode rests.
        let later = 60 * attempt;
        assert_eq!(
            (bench.job("a", later).seeds, given_up.len()),
            (Vec::from_iter(1..=5), 0),
            "attempt {attempt}"
        );
        given_up = bench.gone("a", later).given_up;
    }
    let expected = Vec::from_iter((1..=5).map(|seed| (1000, seed)));
    assert_eq!((&given_up, &bench.board.missing()), (&expected, &expected));
    assert_eq!(bench.board.pending(), 9, "the run does not wait for them");
    let next = bench.job("a", 0);
    assert_eq!(next.seeds, [6, 7]);
    let late = report(&next, "b", vec![score(1, 0.0)]);
    assert_eq!(bench.deliver(&late).unwrap().0.new.len(), 1, "but accepts their scores");
    assert_eq!(bench.board.missing(), expected[1..]);
}

/// A machine that crashes under another name each time, as a container that is restarted does; or a
/// snapshot that cannot be read, or a policy that cannot act, which every evaluator says.
#[test]
fn an_episode_that_fails_again_and_again_is_given_up_but_not_soon() {
    for hands_back in [false, true] {
        let mut bench = Bench::new();
        let (mut failed, mut seconds) = (0, 0);
        while bench.board.missing().is_empty() {
            seconds += 1;
            let evaluator = format!("crash-{seconds}");
            if let Claimed::Job { job, .. } = bench.claim(&evaluator, 1, seconds) {
                failed += 1;
                match hands_back {
                    true => drop(bench.hand_back(&evaluator, &job, Some(seconds)).unwrap()),
                    false => drop(bench.gone(&evaluator, seconds)),
                }
            }
        }
        assert!((600..1200).contains(&seconds), "given up after {seconds} s and {failed} failures");
    }
}

#[test]
fn a_machine_that_fails_again_and_again_does_not_keep_others_from_the_end() {
    let mut bench = Bench::new();
    for seconds in 1..600 {
        let crash = format!("crash-{seconds}");
        if let Claimed::Job { .. } = bench.claim(&crash, 1, seconds) {
            bench.gone(&crash, seconds);
        }
        // It asks just as often, but is not the first.
        if let Claimed::Job { job, .. } = bench.claim("works", seconds, seconds) {
            bench.deliver(&full_report(&job, "works")).unwrap();
        }
    }
    assert_eq!((bench.board.pending(), bench.board.missing()), (0, vec![]));
}

#[test]
fn scores_of_an_earlier_life_count_and_other_weights_are_found_out() {
    let earlier = SavedScores { weights: hash(3000).to_string(), episodes: vec![score(22, 400.0)] };
    let whole = SavedScores {
        weights: hash(4000).to_string(),
        episodes: vec![score(32, 1.0), score(31, 2.0)],
    };
    let mut bench = Bench::after([(3000, earlier), (4000, whole)].into());
    let pending = bench.board.pending();
    assert_eq!(bench.board.add_evaluation(3000, hash(3000), &[21, 22, 23]), Ok(None));
    assert_eq!(bench.board.pending(), pending + 2);
    let complete = bench.board.add_evaluation(4000, hash(4000), &[31, 32]).unwrap().unwrap();
    assert_eq!(complete, [score(31, 2.0), score(32, 1.0)]);
    assert_eq!(
        bench.board.add_evaluation(4000, hash(4000), &[31, 32]),
        Ok(None),
        "asked for again"
    );
    let error = bench.board.add_evaluation(3000, hash(1), &[21, 22, 23]).unwrap_err();
    assert_eq!((error.step, error.found, error.scored), (3000, hash(1), hash(3000).to_string()));
}
