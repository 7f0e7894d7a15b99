//! Tests of the deliveries of practice episodes.

use std::collections::BTreeMap;
use std::sync::mpsc::channel;
use std::time::Duration;

use quad_protocol::{Exploration, Name, encode};
use quad_run::config::Schedule;
use tokio::sync::mpsc::unbounded_channel;

use super::*;
use crate::evaluation::{Opening, Rules};
use crate::fixtures::config;
use crate::live::events::Events;
use crate::live::metrics::Metrics;

const SEED: u64 = 100;

/// The learner's state with one open episode of practice.
fn coordinator() -> Coordinator {
    let run = Name::new("run").unwrap();
    let (metrics, _) = Metrics::new(&run, 1, &[]).unwrap();
    let rules = Rules {
        run,
        incarnation: 1,
        task: quad_dataset::environment::find("hopper").unwrap().into(),
        seed: 0,
        dims: (11, 3),
        episodes: 2,
        schedule: Schedule { start: 0, steps: 10, eval_interval: 10 },
        job_episodes: [5, 20],
        lease: Duration::from_secs(10),
    };
    let coordinator =
        Coordinator::new(rules, BTreeMap::new(), metrics, Events(unbounded_channel().0));
    let exploration = Exploration::Uniform;
    let opening = Opening { episode: 0, step: 10, seed: SEED, exploration };
    coordinator.open_practice(&opening, Hash::of(b"weights"));
    coordinator
}

/// The frame of the episode, whole in one piece.
fn piece() -> Piece {
    let [evaluator, run, precision] = ["a", "run", "f32"].map(|name| Name::new(name).unwrap());
    let mut episode = Episode {
        observations: vec![0.0; 3 * 11],
        actions: vec![0.0; 2 * 3],
        rewards: vec![1.0, 2.0],
        ..Episode::new(10, Hash::of(b"weights"), precision, SEED)
    };
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    (episode.score.episode_return, episode.score.length) = (3.0, 2);
    episode.score.score = hopper.normalized_score(3.0);
    let (bytes, offset) = (encode(&episode).unwrap(), 0);
    let (hash, length) = (Hash::of(&bytes), bytes.len() as u32);
    Piece { evaluator, run, incarnation: 1, job: 1, seed: SEED, hash, length, offset, bytes }
}

#[test]
fn an_episode_is_whole_once_in_a_batch_and_other_bits_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let config = config("a", 0);
    let (dir, _) = RunDir::create(&folder.path().join("a"), &config).unwrap();
    let (inbox, _recorded) = channel();
    let (coordinator, piece) = (coordinator(), piece());
    let mut experience = Experience::open(&dir, &config.experiment, inbox, &coordinator).unwrap();

    let mut first = || experience.add(&piece, |_| false);
    assert!(matches!(first(), Ok(Added::Whole(0, _))));
    assert!(matches!(first(), Ok(Added::Whole(0, _))), "it was not written");
    // Another evaluator has played it, too.
    let second = experience.add(&piece, |number| number == 0);
    let waits = PieceReply::Continue { incarnation: 1, offset: 0 };
    assert!(matches!(second, Ok(Added::Reply(reply)) if reply == waits));

    coordinator.record_practice(SEED, piece.hash);
    for (hash, differences) in [(piece.hash, 0), (Hash::of(b"other bits"), 1)] {
        let again = experience.add(&Piece { hash, ..piece.clone() }, |_| false);
        let recorded = PieceReply::Recorded { incarnation: 1, duplicate: true };
        assert!(matches!(again, Ok(Added::Reply(reply)) if reply == recorded));
        assert_eq!(coordinator.metrics.practice.differences.get(), differences);
    }
}
