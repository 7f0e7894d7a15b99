//! Tests of `live/requests.rs`.

use quad_protocol::{EpisodeScore, Hash, Name, ScoreReport};

use super::*;

#[test]
fn an_honest_message_is_far_from_too_large() {
    let longest = Name::new("n".repeat(Name::MAX_LENGTH)).unwrap();
    let episode = EpisodeScore { seed: 1, episode_return: 1.0, length: 1, score: 1.0 };
    let report = ScoreReport {
        evaluator: longest.clone(),
        run: longest.clone(),
        incarnation: 1,
        job: 1,
        step: 1,
        weights: Hash::of(b"weights"),
        precision: longest,
        episodes: vec![episode; 256], // more than an evaluator would do
    };
    assert!(encode(&report).unwrap().len() < MOST_BYTES / 2);
}
