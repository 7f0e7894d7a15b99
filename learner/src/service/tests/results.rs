//! Tests of results, from their arrival to their acknowledgment.

use quad_protocol::{Episode, Piece, encode};
use quad_run::folder::SavedScores;

use super::super::{End, OtherWeights};
use super::*;

const SEED: u64 = 100;
/// Bytes of the longest frame: a thousand steps and a state, each of 16 numbers.
const LONGEST: u32 = 1001 * 16 * 4 + 1024;

/// An online episode of two steps.
fn episode(reward: f32) -> Episode {
    Episode {
        score: EpisodeScore { length: 2, ..score(SEED, 2.0 * f64::from(reward)) },
        observations: vec![0.0; 3 * 11],
        actions: vec![0.0; 2 * 3],
        rewards: vec![reward; 2],
        ..Episode::new(500, hash(500), name("f32"), SEED)
    }
}

/// An episode's frame in one piece.
fn piece(episode: &Episode) -> Piece {
    let frame = encode(episode).unwrap();
    Piece {
        evaluator: name("a"),
        run: name("run"),
        incarnation: INCARNATION,
        job: 1,
        seed: SEED,
        hash: Hash::new(&frame),
        length: frame.len() as u32,
        offset: 0,
        bytes: frame,
    }
}

fn deliver_piece(bench: &mut Bench, piece: Piece) -> Vec<Order<u32>> {
    bench.handle(Input::Piece(0, piece), 0);
    bench.flush()
}

/// Delivers the online episode with the seed 100.
pub(super) fn deliver_episode(bench: &mut Bench) {
    let orders = deliver_piece(bench, piece(&episode(1.0)));
    assert!(orders.iter().any(|order| matches!(order, Order::Learn { number: 0, .. })));
}

#[test]
fn an_episode_that_comes_again_with_other_bits_is_counted() {
    let mut bench = Bench::new();
    bench.open_online(0);
    deliver_episode(&mut bench);
    for (reward, differs) in [(1.0, false), (2.0, true)] {
        let orders = deliver_piece(&mut bench, piece(&episode(reward)));
        let is_counted = |order: &Order<u32>| matches!(order, Order::Count(Count::Difference));
        assert_eq!(orders.iter().any(is_counted), differs);
    }
}

#[test]
fn an_episode_that_does_not_fit_its_opening_is_refused() {
    let mut bench = Bench::new();
    bench.open_online(0);
    let refusals: [(fn(&mut Episode), _); 6] = [
        (|episode| episode.score.seed = 101, "unknown_online"),
        (|episode| episode.step = 1000, "unknown_step"),
        (|episode| episode.weights = hash(1), "unknown_weights"),
        (|episode| episode.actions = vec![0.0; 2 * 4], "impossible_rows"),
        (|episode| episode.rewards[0] = 1.5, "impossible_episode"),
        (|episode| episode.score.score += 1.0, "impossible_episode"),
    ];
    for (change, refusal) in refusals {
        let mut episode = episode(1.0);
        change(&mut episode);
        assert_eq!(rejected(&deliver_piece(&mut bench, piece(&episode))), Some(refusal));
    }
    let changes: [(fn(&mut Piece), _); 4] = [
        (|piece| piece.length = LONGEST, None),
        (|piece| piece.length = LONGEST + 1, Some("impossible_rows")),
        (|piece| piece.run = name("other"), Some("unknown_run")),
        (|piece| piece.seed = 102, Some("unknown_online")),
    ];
    for (change, refusal) in changes {
        let mut piece = piece(&episode(1.0));
        change(&mut piece);
        assert_eq!(rejected(&deliver_piece(&mut bench, piece)), refusal);
    }
}

/// Gives the first episode this return, and the score of it.
fn set_return(report: &mut ScoreReport, episode_return: f64) {
    report.episodes[0] = score(report.episodes[0].seed, episode_return);
}

#[test]
fn a_report_that_fits_no_evaluation_is_refused() {
    let mut bench = Bench::new();
    let good = report(&bench.job("a", 0), "a");
    let refusals: [(fn(&mut ScoreReport), _); 14] = [
        (|report| report.run = name("other"), "unknown_run"),
        (|report| report.step = 3500, "not_open_yet"),
        (|report| report.step = 1500, "unknown_step"),
        (|report| report.step = 4000, "unknown_step"),
        (|report| report.step = 2000, "unknown_weights"),
        (|report| report.weights = hash(2000), "unknown_weights"),
        (|report| report.episodes[0].seed = 11, "unknown_seed"),
        (|report| report.episodes[1] = report.episodes[0], "unknown_seed"),
        (|report| report.episodes[0].length = 0, "impossible_episode"),
        (|report| report.episodes[0].length = 1001, "impossible_episode"),
        (|report| report.episodes[0].score = 99.0, "impossible_episode"),
        (|report| set_return(report, f64::NAN), "impossible_episode"),
        (|report| set_return(report, f64::INFINITY), "impossible_episode"),
        (|report| set_return(report, -1e200), "impossible_episode"),
    ];
    for (change, refusal) in refusals {
        let mut bad = good.clone();
        change(&mut bad);
        assert_eq!(rejected(&bench.deliver(bad)), Some(refusal));
    }
    assert_eq!(bench.pending(), 14);
    bench.deliver(good);
    assert_eq!(bench.pending(), 9);
}

#[test]
fn a_step_of_other_weights_than_were_scored_ends_the_run() {
    let mut bench = Bench::empty(7);
    let saved = SavedScores { weights: hash(1000).to_string(), episodes: Vec::new() };
    bench.service.earlier.insert(1000, saved);
    bench.open_evaluation(2000);
    assert!(bench.open_evaluation(2000).is_empty(), "again");
    let trained = hash(1);
    for step in [1000, 2000] {
        let orders = bench.handle(Input::Snapshot { step, weights: trained }, 0);
        let error = OtherWeights { step, trained, scored: hash(step).to_string() };
        assert!(matches!(&orders[..], [Order::End(End::OtherWeights(other))] if *other == error));
    }
}
