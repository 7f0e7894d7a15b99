//! Tests of results, from their arrival to their acknowledgment.

use quad_protocol::{Episode, Piece, PieceReply, ScoreReply, encode};

use super::super::{End, OtherWeights};
use super::*;

const FULL: &str = "no space left";
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

/// An episode's frame in pieces of so many bytes.
fn pieces(episode: &Episode, most: usize) -> Vec<Piece> {
    let frame = encode(episode).unwrap();
    let piece = |(number, bytes): (usize, &[u8])| Piece {
        evaluator: name("a"),
        run: name("run"),
        incarnation: INCARNATION,
        job: 1,
        seed: SEED,
        hash: Hash::new(&frame),
        length: frame.len() as u32,
        offset: (number * most) as u32,
        bytes: bytes.to_vec(),
    };
    frame.chunks(most).enumerate().map(piece).collect()
}

/// Delivers the online episode with the seed 100.
pub(super) fn deliver_episode(bench: &mut Bench) {
    bench.handle(Input::Piece(0, pieces(&episode(1.0), 30_000).remove(0)), 0);
    let orders = bench.flush(Ok(()));
    assert!(orders.iter().any(|order| matches!(order, Order::Learn { number: 0, .. })));
}

/// The answers to queries about pieces, by query; `None` if it is to be tried again.
fn answers(orders: &[Order<u32>]) -> Vec<(u32, Option<PieceReply>)> {
    let answer = |order: &Order<u32>| match order {
        Order::Reply(query, Answer::Piece(reply)) => Some((*query, Some(reply.clone()))),
        Order::Reply(query, Answer::TryAgain(_)) => Some((*query, None)),
        _ => None,
    };
    orders.iter().filter_map(answer).collect()
}

#[test]
fn an_episode_is_learned_from_once_and_other_bits_are_counted() {
    let (mut bench, incarnation) = (Bench::new(), INCARNATION);
    bench.open_online(0);
    let [first, last] = pieces(&episode(1.0), 200).try_into().unwrap();
    let [other, _] = pieces(&episode(2.0), 200).try_into().unwrap();
    let resume = |offset| Some(PieceReply::Continue { incarnation, offset });
    for (piece, offset) in [(&last, 0), (&first, 200)] {
        bench.handle(Input::Piece(1, piece.clone()), 0);
        assert_eq!(answers(&bench.flush(Ok(()))), [(1, resume(offset))]);
    }
    // The last piece comes twice, and another evaluator's first.
    for (query, piece) in [(1, &last), (2, &last), (3, &other)] {
        bench.handle(Input::Piece(query, piece.clone()), 0);
    }
    let refused = bench.flush(Err(FULL.to_owned()));
    assert_eq!(answers(&refused), [(2, resume(200)), (3, resume(0)), (1, None)]);

    let recorded = |duplicate| Some(PieceReply::Recorded { incarnation, duplicate });
    for (piece, duplicate, differs) in
        [(&last, false, false), (&last, true, false), (&other, true, true)]
    {
        bench.handle(Input::Piece(1, piece.clone()), 0);
        let orders = bench.flush(Ok(()));
        assert_eq!(answers(&orders), [(1, recorded(duplicate))]);
        let is_learned = orders.iter().any(|order| matches!(order, Order::Learn { number: 0, .. }));
        assert_eq!(is_learned, !duplicate);
        let counted = |order: &Order<u32>| matches!(order, Order::Count(Count::Difference));
        assert_eq!(orders.iter().any(counted), differs);
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
        bench.handle(Input::Piece(0, pieces(&episode, 30_000).remove(0)), 0);
        assert_eq!(rejected(&bench.flush(Ok(()))), Some(refusal));
    }
    let changes: [(fn(&mut Piece), _); 4] = [
        (|piece| piece.length = LONGEST, None),
        (|piece| piece.length = LONGEST + 1, Some("impossible_rows")),
        (|piece| piece.run = name("other"), Some("unknown_run")),
        (|piece| piece.seed = 102, Some("unknown_online")),
    ];
    for (change, refusal) in changes {
        let mut piece = pieces(&episode(1.0), 200).remove(0);
        change(&mut piece);
        bench.handle(Input::Piece(0, piece), 0);
        assert_eq!(rejected(&bench.flush(Ok(()))), refusal);
    }
}

#[test]
fn scores_are_acknowledged_once_they_are_on_the_disk() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let part = ScoreReport { episodes: vec![score(job.seeds[0], 500.0)], ..report(&job, "a") };
    let replies = |orders: Vec<Order<u32>>| {
        Vec::from_iter(orders.into_iter().filter_map(|order| match order {
            Order::Reply(_, Answer::Scores(ScoreReply::Recorded { new, duplicates, .. })) => {
                Some((new, duplicates))
            }
            Order::Reply(_, Answer::TryAgain(reason)) => {
                assert_eq!(reason, "it could not be saved, try again: no space left");
                Some((0, 0))
            }
            _ => None,
        }))
    };
    // Two evaluators have run the same episode.
    for (disk, expected) in [
        (Err(FULL.to_owned()), [(0, 0), (0, 0)]),
        (Ok(()), [(1, 0), (4, 1)]),
        (Ok(()), [(0, 1), (0, 5)]),
    ] {
        bench.handle(Input::Scores(1, part.clone()), 0);
        bench.handle(Input::Scores(2, report(&job, "b")), 0);
        assert_eq!(replies(bench.flush(disk)), expected);
    }
    assert_eq!(bench.pending(), 9);
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
fn scores_of_an_earlier_incarnation_count_unless_the_weights_differ() {
    let saved = |step, episodes| {
        let weights = hash(step).to_string();
        (step, SavedScores { weights, episodes })
    };
    let scores = |step| Vec::from_iter(seeds(step).into_iter().map(|seed| score(seed, 4.0)));
    let reversed = scores(2000).into_iter().rev().collect();
    let mut bench =
        Bench::empty(7, [saved(1000, scores(1000)[1..].to_vec()), saved(2000, reversed)].into());
    assert!(bench.open_evaluation(1000).is_empty());
    assert_eq!(bench.pending(), 1);
    let [Order::Evaluated { step: 2000, scores: complete, earlier: true }] =
        &bench.open_evaluation(2000)[..]
    else {
        panic!("it is complete");
    };
    assert_eq!(*complete, scores(2000));
    assert!(bench.open_evaluation(2000).is_empty(), "again");
    assert_eq!(bench.pending(), 1);
    let weights = hash(1);
    let orders = bench.handle(Input::Snapshot { step: 1000, weights }, 0);
    let scored = hash(1000).to_string();
    let error = OtherWeights { step: 1000, trained: weights, scored };
    assert!(matches!(&orders[..], [Order::End(End::OtherWeights(other))] if *other == error));
}
