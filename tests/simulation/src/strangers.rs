//! Well-formed nonsense: messages that no evaluator of ours sends.

use quad_protocol::{
    EpisodeScore, Exploration, Hash, JobRequest, Piece, ScoreReport, encode, episode_seeds,
    online_seed,
};
use rand::Rng;

use crate::arithmetic::{play, precision};
use crate::world::{Query, World, name};

/// A message with names, numbers and hashes that may be those of the run.
pub fn query(world: &mut World) -> Query {
    let settings = &world.settings;
    let (steps, episodes) = (settings.schedule.steps, settings.episodes);
    let rng = &mut world.rng;
    let evaluator = match rng.random_bool(0.5) {
        true => name(&format!("e{}", rng.random_range(0..3))),
        false => name(&format!("stranger-{}", rng.random_range(0..5))),
    };
    let step = rng.random_range(0..=steps);
    let (incarnation, job) = (world.learner.incarnation, rng.random_range(0..20));
    let piece = |seed, hash, length, offset, bytes| {
        let (evaluator, run) = (evaluator.clone(), name("run"));
        let piece = Piece { evaluator, run, incarnation, job, seed, hash, length, offset, bytes };
        Query::Piece(piece)
    };
    match rng.random_range(0..6) {
        0 => {
            let environments = vec![["robot", "other"][rng.random_range(0..2)].to_owned()];
            let evaluator = name(&format!("stranger-{}", rng.random_range(0..5)));
            Query::Job(JobRequest::Claim { evaluator, attempt: rng.random(), environments })
        }
        1 => {
            let evaluator = name(&format!("stranger-{}", rng.random_range(0..5)));
            Query::Job(JobRequest::HandBack { evaluator, job, failed: Some("nonsense".to_owned()) })
        }
        2 | 3 => {
            // Of other weights, or of seeds that are not the run's.
            let saved = world.disk.snapshots.get(&step).copied();
            let weights = saved.filter(|_| rng.random_bool(0.5));
            let seeds = match weights {
                Some(_) => episode_seeds(1, step, episodes),
                None => episode_seeds(0, step, episodes),
            };
            let score = |seed| EpisodeScore { seed, episode_return: 7.0, length: 1, score: 7.0 };
            Query::Scores(ScoreReport {
                evaluator,
                run: name("run"),
                incarnation,
                job,
                step,
                weights: weights.unwrap_or_else(|| Hash::new(b"guessed")),
                precision: precision(0),
                episodes: seeds.into_iter().map(score).collect(),
            })
        }
        4 => {
            let bytes = vec![7; rng.random_range(1..200)];
            let length = rng.random_range(bytes.len()..2000) as u32;
            let offset = rng.random_range(0..=length - bytes.len() as u32);
            let seed = online_seed(0, rng.random_range(0..6));
            piece(seed, Hash::new(b"guessed"), length, offset, bytes)
        }
        // A whole episode, of other weights or of another seed.
        _ => {
            let number = rng.random_range(0..6);
            let (seed, other) = (online_seed(0, number), online_seed(0, number + 1));
            let (weights, played) = match world.disk.snapshots.get(&step) {
                Some(weights) if rng.random() => (*weights, other),
                _ => (Hash::new(b"guessed"), seed),
            };
            let episode = play(settings, (step, weights), played, Exploration::Uniform, 0);
            let bytes = encode(&episode).expect("its numbers are finite");
            piece(seed, Hash::new(&bytes), bytes.len() as u32, 0, bytes)
        }
    }
}
