//! Tests of score reports.

use super::*;

#[test]
fn scores_complete_jobs_and_evaluations_and_count_once() {
    let mut bench = Bench::new();
    let (first, second) = (bench.job("a", 0), bench.job("b", 0));
    let part = report(&first, "a", vec![score(1, 0.0), score(3, 0.0)]);
    assert_eq!(bench.deliver(&part), Ok((2, 0, 0)), "new, duplicates, completed jobs");
    assert_eq!(bench.deliver(&full_report(&first, "a")), Ok((3, 2, 1)), "the rest");
    assert_eq!(bench.deliver(&full_report(&first, "a")), Ok((0, 5, 0)), "delivered again");
    let changed = report(&first, "a", vec![score(1, 3000.0)]);
    assert_eq!(bench.deliver(&changed), Ok((0, 1, 0)));
    assert_eq!((bench.board.pending(), &bench.completed), (9, &None));

    assert_eq!(bench.deliver(&full_report(&second, "b")), Ok((2, 0, 1)));
    let scores = bench.completed.take().unwrap();
    let seeds = Vec::from_iter(scores.iter().map(|score| score.seed));
    assert_eq!(seeds, [1, 2, 3, 4, 5, 6, 7]);
    assert_eq!(scores[0].episode_return, 0.0, "the first score of an episode stays");
    assert_eq!(bench.job("a", 1).step, 2000, "the next evaluation");
}

/// A learner that is back at an earlier step makes the snapshot again.
#[test]
fn scores_that_come_before_their_evaluation_count_once_it_is_open() {
    let mut bench = Bench::new();
    let job = Job { step: 3000, weights: hash(3000), seeds: vec![21, 22], ..bench.job("a", 0) };
    let early = full_report(&job, "a");
    assert_eq!(bench.deliver(&early), Err(Refusal::NotYet));
    bench.board.add_evaluation(3000, hash(3000), &[21, 22, 23]).unwrap();
    assert_eq!(bench.deliver(&early), Ok((2, 0, 0)));
}

/// The job may be of an earlier incarnation of the learner, of another evaluator, or forgotten.
#[test]
fn a_report_of_any_job_counts_if_step_weights_and_seeds_fit() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let waiting = report(&job, "b", vec![score(6, 0.0)]);
    let earlier = ScoreReport { incarnation: INCARNATION - 1, job: 99, ..waiting };
    assert_eq!(bench.deliver(&earlier), Ok((1, 0, 0)));
    let other = ScoreReport { job: 77, ..full_report(&job, "c") };
    assert_eq!(bench.deliver(&other), Ok((5, 0, 1)), "the episodes of a's job");
    assert_eq!(bench.deliver(&full_report(&job, "a")), Ok((0, 5, 0)));
    assert_eq!(bench.job("a", 1).seeds, [7]);
}

#[test]
fn the_first_delivery_counts_when_a_lost_evaluator_comes_back() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.expire(10);
    let again = bench.job("b", 10);
    assert_eq!(bench.deliver(&full_report(&lost, "a")), Ok((5, 0, 1)), "b's job is over");
    assert_eq!(bench.job("c", 11).seeds, [6, 7]);
    assert_eq!(bench.deliver(&full_report(&again, "b")), Ok((0, 5, 0)));
    assert_eq!(bench.board.pending(), 9);
}

#[test]
fn a_report_that_fits_no_evaluation_is_refused() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let good = full_report(&job, "a");
    let changed = |change: fn(&mut ScoreReport)| {
        let mut report = good.clone();
        change(&mut report);
        report
    };
    for (bad, refusal) in [
        (changed(|report| report.run = name("other")), Refusal::Run),
        (changed(|report| report.step = 3500), Refusal::NotYet),
        (changed(|report| report.step = 1500), Refusal::Step),
        (changed(|report| report.step = 4000), Refusal::Step),
        (changed(|report| report.step = 2000), Refusal::Weights),
        (changed(|report| report.weights = hash(2000)), Refusal::Weights),
        (changed(|report| report.episodes = vec![score(11, 0.0)]), Refusal::Seed(11)),
        (changed(|report| report.episodes = vec![score(1, 0.0); 2]), Refusal::Seed(1)),
        (changed(|report| report.episodes[0].length = 0), Refusal::Episode(1)),
        (changed(|report| report.episodes[0].length = 1001), Refusal::Episode(1)),
        (changed(|report| report.episodes[0].score = 99.0), Refusal::Episode(1)),
    ] {
        assert_eq!(bench.board.validate(&bad), Err(refusal));
    }
    for episode_return in [f64::NAN, f64::INFINITY, 2e12, -1e200] {
        let bad = report(&job, "a", vec![score(1, episode_return)]);
        assert_eq!(bench.board.validate(&bad), Err(Refusal::Episode(1)));
    }
    assert_eq!(bench.board.pending(), 14);
    assert_eq!(bench.deliver(&good), Ok((5, 0, 1)));
}
