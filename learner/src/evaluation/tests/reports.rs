//! What becomes of a report.

use super::*;

#[test]
fn scores_complete_a_job_and_an_evaluation_once() {
    let mut bench = Bench::new();
    let (first, second) = (bench.job("a", 0), bench.job("b", 0));
    let (validated, recorded) = bench.deliver(&full_report(&first, "a")).unwrap();
    assert_eq!((validated.new.len(), validated.duplicates), (5, 0));
    assert_eq!(recorded, Recorded { jobs_completed: 1, ..Recorded::default() });
    assert_eq!(bench.board.pending(), 9);

    let (_, recorded) = bench.deliver(&full_report(&second, "b")).unwrap();
    let seeds: Vec<_> =
        recorded.evaluation_completed.unwrap().iter().map(|score| score.seed).collect();
    assert_eq!(seeds, Vec::from_iter(1..=7), "in the order of the evaluation's seeds");
    assert_eq!(bench.job("a", 1).step, 2000, "an evaluator that has delivered gets the next");
}

#[test]
fn a_report_delivered_again_is_accepted_and_counted_once() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.deliver(&full_report(&job, "a")).unwrap();
    let (validated, recorded) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((validated.new.len(), validated.duplicates), (0, 5));
    assert_eq!(recorded, Recorded::default());
    assert_eq!(bench.board.pending(), 9);
}

#[test]
fn the_first_score_of_an_episode_stays() {
    let mut bench = Bench::new();
    let (job, rest) = (bench.job("a", 0), bench.job("b", 0));
    bench.deliver(&full_report(&job, "a")).unwrap();
    let changed = report(&job, "a", vec![score(1, 3000.0)]);
    assert_eq!(bench.deliver(&changed).unwrap().0.duplicates, 1);
    let (_, recorded) = bench.deliver(&full_report(&rest, "b")).unwrap();
    let scores = recorded.evaluation_completed.unwrap();
    assert!(scores.iter().all(|score| score.episode_return == 500.0));
}

#[test]
fn a_job_may_be_delivered_in_parts() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let (_, recorded) =
        bench.deliver(&report(&job, "a", vec![score(1, 0.0), score(3, 0.0)])).unwrap();
    assert_eq!(recorded.jobs_completed, 0);
    assert_eq!(bench.board.pending(), 12);
    let (validated, recorded) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((validated.new.len(), validated.duplicates, recorded.jobs_completed), (3, 2, 1));
}

/// An older incarnation of the learner handed the job out, or to another evaluator, or the job is
/// not known any more.
#[test]
fn any_lifes_report_is_welcome_if_step_weights_and_seeds_fit() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let earlier = ScoreReport {
        incarnation: INCARNATION - 1,
        job: 99,
        ..report(&job, "b", vec![score(6, 0.0)])
    };
    assert_eq!(bench.deliver(&earlier).unwrap().0.new.len(), 1, "an episode that waits");
    let other = ScoreReport { job: 77, ..full_report(&job, "c") };
    let (validated, recorded) = bench.deliver(&other).unwrap();
    assert_eq!((validated.new.len(), recorded.jobs_completed), (5, 1), "episodes that a has");
    let (validated, _) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((validated.new.len(), validated.duplicates), (0, 5));
    assert_eq!(bench.job("a", 1).seeds, [7]);
}

#[test]
fn the_first_delivery_counts_when_a_lost_evaluator_comes_back() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.expire(10);
    let again = bench.job("b", 10);
    let (validated, recorded) = bench.deliver(&full_report(&lost, "a")).unwrap();
    assert_eq!(
        (validated.new.len(), recorded.jobs_completed),
        (5, 1),
        "late, but the first; b's is over"
    );
    assert!(matches!(bench.job("c", 11).seeds[..], [6, 7]), "nothing of it is handed out again");
    let (validated, recorded) = bench.deliver(&full_report(&again, "b")).unwrap();
    assert_eq!((validated.duplicates, recorded.jobs_completed), (5, 0));
    assert_eq!(bench.board.pending(), 9);
}

#[test]
fn a_report_that_fits_no_evaluation_is_refused() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let good = full_report(&job, "a");
    let with_episode =
        |episode: EpisodeScore| ScoreReport { episodes: vec![episode], ..good.clone() };
    let twice = ScoreReport { episodes: vec![score(1, 0.0), score(1, 0.0)], ..good.clone() };
    let cases = [
        (ScoreReport { run: name("other"), ..good.clone() }, Refusal::Run),
        (ScoreReport { step: 3000, ..good.clone() }, Refusal::Step),
        (ScoreReport { step: 2000, ..good.clone() }, Refusal::Weights),
        (ScoreReport { weights: hash(2000), ..good.clone() }, Refusal::Weights),
        (with_episode(score(11, 0.0)), Refusal::Seed(11)),
        (twice, Refusal::Seed(1)),
        (with_episode(EpisodeScore { length: 0, ..score(1, 0.0) }), Refusal::Episode(1)),
        (with_episode(EpisodeScore { length: 1001, ..score(1, 0.0) }), Refusal::Episode(1)),
        (with_episode(EpisodeScore { score: 99.0, ..score(1, 0.0) }), Refusal::Episode(1)),
        (with_episode(score(1, f64::NAN)), Refusal::Episode(1)),
        (with_episode(score(1, f64::INFINITY)), Refusal::Episode(1)),
        (with_episode(score(1, 2e12)), Refusal::Episode(1)),
        (with_episode(score(1, -1e200)), Refusal::Episode(1)),
    ];
    for (report, refusal) in cases {
        assert_eq!(bench.board.validate(&report), Err(refusal));
    }
    assert_eq!(bench.board.pending(), 14);
    assert_eq!(bench.deliver(&good).unwrap().0.new.len(), 5);
}
