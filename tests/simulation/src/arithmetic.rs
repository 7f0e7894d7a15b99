//! Results of training and policies, in place of networks': hashes of everything that they depend
//! on. Two runs have learned from the same input if and only if their hashes are equal.

use quad_protocol::{Episode, EpisodeScore, Exploration, Hash, Name};

use crate::settings::Settings;

/// Sizes of the made-up robot's action.
pub const ACTION_DIM: usize = 1;
/// Most rows of an episode.
const MOST_ROWS: u64 = 6;

/// A number that depends on all bits of two others.
pub fn mix(a: u64, b: u64) -> u64 {
    // SplitMix64's finalizer.
    let mut z = a.rotate_left(29) ^ b.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// A number that depends on all bits of an episode that training learns from.
pub fn digest(episode: &Episode) -> u64 {
    let Episode { score, terminated, observations, actions, rewards, .. } = episode;
    let numbers = observations.iter().chain(actions).chain(rewards);
    let digest = mix(score.seed, u64::from(*terminated));
    numbers.fold(digest, |digest, number| mix(digest, number.to_bits().into()))
}

/// The snapshot after a gradient step.
pub fn snapshot(step: u64, digest: u64) -> Hash {
    Hash::new(&mix(step, digest).to_le_bytes())
}

fn number(hash: &Hash) -> u64 {
    let [a, b, c, d, e, f, g, h, ..] = *hash.bytes();
    u64::from_le_bytes([a, b, c, d, e, f, g, h])
}

/// The score of an evaluation's episode. Evaluators of another `kind` compute other bits.
pub fn score(weights: &Hash, seed: u64, kind: u64) -> EpisodeScore {
    let bits = mix(mix(number(weights), seed), kind);
    let episode_return = (bits % 1000) as f64;
    EpisodeScore { seed, episode_return, length: 1 + (bits % 7) as u32, score: episode_return }
}

/// An online episode. Evaluators of another `kind` compute other bits.
pub fn play(
    settings: &Settings,
    (step, weights): (u64, Hash),
    seed: u64,
    exploration: Exploration,
    kind: u64,
) -> Episode {
    let rule = match exploration {
        Exploration::Uniform => 1,
        Exploration::Policy { .. } => 2,
    };
    let bits = mix(mix(mix(number(&weights), seed), rule), kind);
    let rows = (1 + bits % MOST_ROWS) as usize;
    let reward = (bits % 100) as f32;
    let episode_return = f64::from(reward) * rows as f64;
    Episode {
        score: EpisodeScore { seed, episode_return, length: rows as u32, score: episode_return },
        terminated: bits.is_multiple_of(2),
        observations: vec![(bits % 9973) as f32; (rows + 1) * settings.observation_dim],
        actions: vec![(bits % 9949) as f32; rows * ACTION_DIM],
        rewards: vec![reward; rows],
        ..Episode::new(step, weights, precision(kind), seed)
    }
}

/// The arithmetic of a kind of evaluator.
pub fn precision(kind: u64) -> Name {
    #[allow(clippy::unwrap_used)]
    Name::new(format!("kind-{kind}")).unwrap()
}
