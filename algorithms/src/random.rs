//! Where the learner's random numbers come from: a stream per purpose, each a function of the run's
//! seed and a counter, so that no generator holds anything that a saved run would have to remember.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// What random numbers are for.
#[derive(Clone, Copy)]
#[repr(u64)]
pub enum Purpose {
    /// Initial weights; counted by network.
    Weights = u64::from_be_bytes(*b"weights "),
    /// The noise of an update; counted by gradient step.
    Noise = u64::from_be_bytes(*b"noise   "),
    /// Actions of a clone in the data's states; counted by transition.
    Actions = u64::from_be_bytes(*b"actions "),
}

/// The stream of a run's seed for a purpose.
pub fn stream(seed: u64, purpose: Purpose, count: u64) -> ChaCha8Rng {
    let mut generator = ChaCha8Rng::seed_from_u64(seed ^ purpose as u64);
    generator.set_stream(count);
    generator
}
