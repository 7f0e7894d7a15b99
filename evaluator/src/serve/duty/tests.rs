//! Tests of jobs that fail, of refused results, and of a leave; the rest is the simulation's.

use quad_protocol::{Episode, EpisodeScore, Exploration, Name};

use super::super::fixtures::job;
use super::*;

const SCORE: EpisodeScore = EpisodeScore { seed: 1, episode_return: 2.0, length: 1, score: 3.0 };

fn name() -> Name {
    Name::new("one").unwrap()
}

/// A duty in a turn, with a claimed job, which is played with these results.
fn played(job: &Job, results: Result<Option<Episode>, &str>) -> Duty {
    let mut duty = Duty::new(Instant::now());
    duty.follow(&[job.incarnation].into(), Instant::now());
    duty.begin_turn();
    assert_eq!(duty.next(7), Some(Step::Claim { attempt: 7 }));
    duty.claimed(JobReply::Job(job.clone()), 1.0, Instant::now());
    assert_eq!(duty.next(8), Some(Step::Play(job.clone())));
    let owed = |episode| Owed::new(job, name(), name(), vec![(SCORE, episode)]).unwrap();
    duty.played(results.map(owed));
    duty
}

fn scored() -> Duty {
    played(&job(), Ok(None))
}

/// An online episode, in one piece.
fn played_online() -> Duty {
    let job = Job { exploration: Some(Exploration::Uniform), ..job() };
    let (observations, actions, rewards) = (vec![0.0; 2], vec![0.0], vec![2.0]);
    let new = Episode::new(job.step, job.weights, name(), 1);
    played(&job, Ok(Some(Episode { score: SCORE, observations, actions, rewards, ..new })))
}

fn assert_hands_back(duty: &mut Duty, reason: Option<&str>) {
    let Some(Step::HandBack { job: 1, incarnation: 1, failed }) = duty.next(9) else {
        panic!("{duty:?}");
    };
    assert_eq!(failed.as_deref(), reason);
}

/// Else the learner would wait for them until the lease ends.
#[test]
fn a_job_that_fails_or_whose_results_are_refused_is_handed_back_with_the_reason() {
    assert_hands_back(&mut played(&job(), Err("no moon")), Some("no moon"));
    let (now, incarnation, reason) = (Instant::now(), 1, "too good".to_owned());
    let mut duty = scored();
    assert!(matches!(duty.next(9), Some(Step::Scores(_))));
    duty.scored(ScoreReply::Refused { incarnation, reason: reason.clone() }, now);
    assert_hands_back(&mut duty, Some("it refused the scores: too good"));
    let mut duty = played_online();
    assert!(matches!(duty.next(9), Some(Step::Piece(_))));
    duty.sent(PieceReply::Refused { incarnation, reason }, now).unwrap();
    assert_hands_back(&mut duty, Some("it refused the episode with seed 1: too good"));
}

/// A learner that answers may soon have room on its disk; an episode of a robot or a person cannot be
/// played again.
#[test]
fn a_leaving_evaluator_delivers_as_long_as_it_may_help_then_hands_its_job_back() {
    for (mut duty, answered, tries_again) in [
        (scored(), true, true),
        (scored(), false, false),
        (played_online(), true, true),
        (played_online(), false, true),
    ] {
        duty.leave();
        let results = duty.next(9);
        assert!(duty.leaving_failed(answered, false));
        assert_eq!(duty.next(9) == results, tries_again);
        // It is late: after the results, the job cannot be handed back either.
        assert_eq!(duty.leaving_failed(answered, true), tries_again);
        if tries_again {
            assert_hands_back(&mut duty, None);
        }
    }
}
