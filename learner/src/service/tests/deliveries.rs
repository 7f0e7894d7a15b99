//! Tests of deliveries, from their arrival to their acknowledgment.

use quad_protocol::{Episode, Exploration, Piece, PieceReply, ScoreReply, encode};

use super::super::message::{Answer, Count, Input, Order, TryAgain};
use super::super::outcomes::Opening;
use super::super::service::Service;
use super::*;

const SEED: u64 = 100;
const FULL: &str = "no space left";

/// A service with an evaluation of two episodes and an open online episode. Queries are numbers.
fn service() -> Service<u32> {
    let now = Instant::now();
    let mut service = Service::new(rules(2), BTreeMap::new(), &[], now);
    service.handle(Input::Snapshot { step: 1000, weights: hash(1000) }, now);
    let exploration = Exploration::Uniform;
    let opening = Opening { episode: 0, step: 500, seed: SEED, exploration };
    service.handle(Input::Opened(opening, hash(500)), now);
    service
}

/// The frame of the episode in pieces of so many bytes.
fn pieces(reward: f32, most: usize) -> Vec<Piece> {
    let episode = Episode {
        score: EpisodeScore { length: 2, ..score(SEED, 2.0 * f64::from(reward)) },
        observations: vec![0.0; 3 * 11],
        actions: vec![0.0; 2 * 3],
        rewards: vec![reward; 2],
        ..Episode::new(500, hash(500), name("f32"), SEED)
    };
    let frame = encode(&episode).unwrap();
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

/// Lets the disk take what has arrived, or refuse it. Returns the orders.
fn flush(service: &mut Service<u32>, disk: Result<(), String>) -> Vec<Order<u32>> {
    let now = Instant::now();
    let (mut done, mut orders) = (Vec::new(), service.handle(Input::Flush, now));
    while !orders.is_empty() {
        match orders.remove(0) {
            Order::Decode(frame) => {
                let episode = frame.decode();
                orders.extend(service.handle(Input::Decoded(frame, episode), now));
            }
            Order::Append { .. } => {
                orders.extend(service.handle(Input::Appended([disk.clone(), disk.clone()]), now));
            }
            order => done.push(order),
        }
    }
    done
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
    let (mut service, now, incarnation) = (service(), Instant::now(), INCARNATION);
    let [first, last] = pieces(1.0, 200).try_into().unwrap();
    let [other, _] = pieces(2.0, 200).try_into().unwrap();
    let resume = |offset| Some(PieceReply::Continue { incarnation, offset });
    for (piece, offset) in [(&last, 0), (&first, 200)] {
        service.handle(Input::Piece(1, piece.clone()), now);
        assert_eq!(answers(&flush(&mut service, Ok(()))), [(1, resume(offset))]);
    }
    // The last piece comes twice, and another evaluator's first.
    for (query, piece) in [(1, &last), (2, &last), (3, &other)] {
        service.handle(Input::Piece(query, piece.clone()), now);
    }
    let refused = flush(&mut service, Err(FULL.to_owned()));
    assert_eq!(answers(&refused), [(2, resume(200)), (3, resume(0)), (1, None)]);
    assert!(!refused.iter().any(|order| matches!(order, Order::Learn { .. })));

    service.handle(Input::Piece(1, last.clone()), now);
    let orders = flush(&mut service, Ok(()));
    let recorded = |duplicate| Some(PieceReply::Recorded { incarnation, duplicate });
    assert_eq!(answers(&orders), [(1, recorded(false))]);
    let learned = |order: &&Order<u32>| matches!(order, Order::Learn { number: 0, .. });
    assert_eq!(orders.iter().filter(learned).count(), 1);

    for (piece, differences) in [(&last, 0), (&other, 1)] {
        service.handle(Input::Piece(1, piece.clone()), now);
        let orders = flush(&mut service, Ok(()));
        assert_eq!(answers(&orders), [(1, recorded(true))]);
        let counted = |order: &&Order<u32>| matches!(order, Order::Count(Count::Difference));
        assert_eq!(orders.iter().filter(counted).count(), differences);
    }
}

#[test]
fn scores_are_acknowledged_once_they_are_on_the_disk() {
    let (mut service, now) = (service(), Instant::now());
    let seeds = quad_protocol::episode_seeds(5, 1000, 2);
    let report = |by: &str, seeds: &[u64]| ScoreReport {
        evaluator: name(by),
        run: name("run"),
        incarnation: INCARNATION,
        job: 1,
        step: 1000,
        weights: hash(1000),
        precision: name("f32"),
        episodes: seeds.iter().map(|&seed| score(seed, 500.0)).collect(),
    };
    let replies = |orders: Vec<Order<u32>>| {
        Vec::from_iter(orders.into_iter().filter_map(|order| match order {
            Order::Reply(_, Answer::Scores(ScoreReply::Recorded { new, duplicates, .. })) => {
                Some((new, duplicates))
            }
            Order::Reply(_, Answer::TryAgain(TryAgain::NotSaved(error))) => {
                assert_eq!(error, FULL);
                Some((0, 0))
            }
            _ => None,
        }))
    };
    // Two evaluators have run the same episode.
    for (disk, expected) in [(Err(FULL.to_owned()), [(0, 0), (0, 0)]), (Ok(()), [(1, 0), (1, 1)])] {
        service.handle(Input::Scores(1, report("a", &seeds[..1])), now);
        service.handle(Input::Scores(2, report("b", &seeds)), now);
        assert_eq!(replies(flush(&mut service, disk)), expected);
    }
    assert_eq!(service.gauges().pending, 0);
}
