//! Tests of online episodes.

use quad_protocol::{Episode, Exploration, Piece};

use super::super::outcomes::{OnlineEpisodeState, Opening};
use super::*;

const EXPLORATION: Exploration = Exploration::Policy { noise: 0.1 };

fn opening(episode: u64) -> Opening {
    Opening { episode, step: 500, seed: 100 + episode, exploration: EXPLORATION }
}

/// A bench with two open online episodes.
fn bench() -> Bench {
    let mut bench = Bench::new();
    (0..2).for_each(|episode| bench.board.open_online(&opening(episode), hash(500)));
    bench
}

fn episode(seed: u64) -> Episode {
    Episode {
        score: EpisodeScore { length: 2, ..score(seed, 3.0) },
        observations: vec![0.0; 3 * 11],
        actions: vec![0.0; 2 * 3],
        rewards: vec![1.0, 2.0],
        ..Episode::new(500, hash(500), name("f32"), seed)
    }
}

/// What the learner knows of the first piece of an episode.
fn known(bench: &Bench, seed: u64) -> Result<OnlineEpisodeState, Refusal> {
    bench.board.online(&piece(seed))
}

fn piece(seed: u64) -> Piece {
    Piece {
        evaluator: name("a"),
        run: name("run"),
        incarnation: INCARNATION,
        job: 1,
        seed,
        hash: hash(7),
        length: 1,
        offset: 0,
        bytes: vec![0],
    }
}

#[test]
fn a_piece_of_another_run_or_of_a_frame_that_is_too_long_is_refused() {
    let bench = bench();
    let mut piece = piece(100);
    // Of the longest episode: a thousand steps and a state, each of 16 numbers.
    piece.length = 1001 * 16 * 4 + 1024;
    assert_eq!(bench.board.online(&piece), Ok(OnlineEpisodeState::Open { episode: 0 }));
    piece.length += 1;
    assert_eq!(bench.board.online(&piece), Err(Refusal::Rows(100)));
    piece.run = name("other");
    assert_eq!(bench.board.online(&piece), Err(Refusal::Run));
}

#[test]
fn online_episodes_go_first_one_episode_a_job_in_the_order_of_their_numbers() {
    let mut bench = bench();
    let jobs = ["a", "b"].map(|evaluator| bench.job(evaluator, 0));
    for (job, seed) in jobs.iter().zip([100, 101]) {
        assert_eq!((job.step, &job.seeds[..], job.weights), (500, &[seed][..], hash(500)));
        assert_eq!(job.exploration, Some(EXPLORATION));
    }
    assert_eq!((bench.job("c", 0).step, bench.job("d", 0).exploration), (1000, None));
    assert_eq!(bench.board.pending(), 14, "the run's end waits for evaluations alone");
    assert_eq!(bench.board.weights(500), Some(hash(500)));
}

#[test]
fn an_episode_is_played_until_it_is_recorded_and_counts_once() {
    let mut bench = bench();
    for failure in 0..50 {
        let job = bench.job("a", 100 * failure);
        assert_eq!(job.seeds, [100], "an evaluation's episode would be given up by now");
        bench.hand_back("a", &job, Some(100 * failure)).unwrap();
    }
    let job = bench.job("a", 10_000);
    assert_eq!(known(&bench, 100), Ok(OnlineEpisodeState::Open { episode: 0 }));
    assert_eq!(bench.board.record_experience(100, hash(7)), 1);
    assert_eq!(known(&bench, 100), Ok(OnlineEpisodeState::Recorded(hash(7))));
    assert_eq!(bench.hand_back("a", &job, None), None, "the job is done");
    assert_eq!(bench.job("a", 10_001).seeds, [101]);
    assert_eq!(known(&bench, 102), Err(Refusal::Online(102)));
}

/// Evaluations wait as well: more than the evaluators can do.
#[test]
fn an_episode_for_which_training_has_waited_goes_to_a_second_evaluator() {
    let mut bench = bench();
    let slow = bench.job("slow", 0);
    bench.board.wait_for_experience(1, bench.at(0));
    assert_eq!(bench.job("other", 0).seeds, [101]);
    bench.board.record_experience(101, hash(8));
    bench.progress(&progress(&slow, "slow", 5), 95).unwrap();
    assert_eq!(bench.job("a", 95).exploration, None, "training does not wait for it");
    bench.leave("a", 95);
    bench.board.wait_for_experience(0, bench.at(100));
    assert_eq!(bench.job("a", 119).exploration, None);
    let second = bench.job("b", 120);
    assert_eq!((&second.seeds, second.exploration), (&slow.seeds, slow.exploration));
    assert_eq!(bench.job("c", 160).exploration, None, "two are enough");
    assert_eq!(bench.board.record_experience(100, hash(7)), 2);
}

#[test]
fn an_episode_that_rests_is_not_handed_out_although_one_evaluator_still_plays_it() {
    let mut bench = bench();
    bench.job("slow", 0);
    assert_eq!(bench.job("other", 0).seeds, [101]);
    bench.board.wait_for_experience(0, bench.at(0));
    for second in 20..24 {
        let job = bench.job("a", second);
        assert_eq!(job.seeds, [100]);
        bench.hand_back("a", &job, Some(second)).unwrap();
    }
    assert_eq!(bench.job("a", 24).exploration, None);
}

#[test]
fn only_episodes_that_fit_their_opening_are_accepted() {
    let bench = bench();
    let check = |change: fn(&mut Episode)| {
        let mut episode = episode(100);
        change(&mut episode);
        bench.board.validate_online(0, &episode)
    };
    assert_eq!(check(|_| ()), Ok(()));
    assert_eq!(check(|it| it.score.seed = 101), Err(Refusal::Online(101)), "it is another's");
    assert_eq!(check(|it| it.step = 1000), Err(Refusal::Step));
    assert_eq!(check(|it| it.weights = hash(1)), Err(Refusal::Weights));
    assert_eq!(check(|it| it.actions = vec![0.0; 2 * 4]), Err(Refusal::Rows(100)));
    assert_eq!(check(|it| it.rewards[0] = 1.5), Err(Refusal::Episode(100)));
    assert_eq!(check(|it| it.score.score += 1.0), Err(Refusal::Episode(100)));
}

#[test]
fn between_two_episodes_evaluators_ask_more_often_than_after_the_last() {
    let mut bench = bench();
    bench.present = 1;
    let pause = |bench: &mut Bench| loop {
        match bench.claim("a", 0, 0) {
            Claimed::Wait(pause) => return pause.as_millis(),
            Claimed::Job { job, .. } if job.exploration.is_some() => {
                bench.board.record_experience(job.seeds[0], hash(7));
            }
            Claimed::Job { job, .. } => {
                bench.deliver(&full_report(&job, "a")).unwrap();
            }
        }
    };
    assert_eq!(pause(&mut bench), 100, "none is open, but another will be soon");
    bench.board.end_online();
    assert_eq!(pause(&mut bench), 500);
}

#[test]
fn after_the_end_of_online_learning_no_episode_is_handed_out_and_what_was_open_is_accepted() {
    let mut bench = bench();
    bench.job("a", 0);
    bench.board.expect_online(102);
    bench.board.end_online();
    assert_eq!(bench.job("b", 0).exploration, None);
    assert_eq!(bench.board.validate_online(0, &episode(100)), Ok(()));
    let refused = Err(Refusal::Online(102));
    assert_eq!(known(&bench, 102), refused, "it is not waited for anymore");
    bench.leave("a", 1);
    assert_ne!(bench.job("c", 1).exploration, Some(EXPLORATION), "training has ended");
}
