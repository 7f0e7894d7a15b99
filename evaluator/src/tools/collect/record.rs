//! Mixes episodes of a search's policies, from the first to the last, into one dataset.

use quad_dataset::{D4rlWriter, EnvironmentSpec, Recipe};
use quad_runtime::{Hint, ProgressBar};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::recorder::Recorder;
use super::search::LinearPolicy;
use super::{MUJOCO, OUT, stream};
use crate::sim::Environment;

/// Range of the standard deviation of an episode's Gaussian action noise (actions span ±1): enough
/// to show the effects of other actions in a state, up to more than most gaits survive.
const NOISE: std::ops::Range<f64> = 0.1..0.5;

/// Episodes that run in parallel.
const ROUND: usize = 32;

/// After simulating this many times the wanted transitions, the recorder takes any episode: a
/// search that never got good has none for the upper bands.
const PATIENCE: usize = 4;

/// Stream of an episode's seed for the noise of actions.
const NOISE_STREAM: u64 = 3;

/// Records whole episodes, each of a policy drawn from `policies`, until there are `transitions`
/// rows. Returns each episode's normalized score.
pub fn record(
    spec: &'static EnvironmentSpec,
    recipe: &Recipe,
    policies: &[LinearPolicy],
    transitions: usize,
    mut random: ChaCha8Rng,
    writer: &mut D4rlWriter,
) -> anyhow::Result<Vec<f64>> {
    let recorders = (0..ROUND).map(|_| Recorder::new(spec));
    let mut recorders = recorders.collect::<Result<Vec<_>, _>>().hint(MUJOCO)?;
    let mixture = &recipe.mixture;
    let mut room: Vec<f64> = mixture.iter().map(|(_, share)| share * transitions as f64).collect();
    let mut scores = Vec::new();
    let mut simulated = 0;
    let progress = ProgressBar::new("transitions recorded");
    progress.start(0, transitions as u64);
    loop {
        // An episode beyond the end of the highest unfilled band is useless.
        let patient = simulated <= PATIENCE * transitions;
        let highest = room.iter().rposition(|&room| room > 0.0).filter(|_| patient);
        let next = highest.and_then(|band| mixture.get(band + 1));
        let ceiling = next.map_or(f64::INFINITY, |&(from, _)| from);
        let mut draw = |_| {
            let policy = &policies[random.random_range(0..policies.len())];
            (policy, random.random())
        };
        let drawn: Vec<(&LinearPolicy, u64)> = (0..ROUND).map(&mut draw).collect();
        let running = recorders.par_iter_mut().zip(drawn).with_max_len(1);
        running.for_each(|(recorder, (policy, seed))| play(recorder, policy, seed, ceiling));
        for recorder in &recorders {
            simulated += recorder.length();
            let score = spec.normalized_score(recorder.episode_return);
            let band = mixture.iter().rposition(|&(from, _)| score >= from).unwrap_or(0);
            if recorder.ended() && (room[band] > 0.0 || !patient) {
                room[band] -= recorder.length() as f64;
                recorder.write(writer).hint(OUT)?;
                scores.push(score);
            }
            if writer.rows() >= transitions {
                return Ok(scores);
            }
        }
        progress.advance(writer.rows() as u64);
    }
}

/// Runs an episode to its end, or until its score so far is above `ceiling`.
fn play(recorder: &mut Recorder, policy: &LinearPolicy, seed: u64, ceiling: f64) {
    let spec = recorder.spec();
    let mut random = stream(seed, NOISE_STREAM);
    let deviation = random.random_range(NOISE);
    let mut action = vec![0.0; spec.action_dim];
    recorder.begin(seed);
    while !recorder.ended() && spec.normalized_score(recorder.episode_return) <= ceiling {
        policy.act(recorder.observation(), &mut action);
        for value in &mut action {
            let noise: f64 = StandardNormal.sample(&mut random);
            *value = (f64::from(*value) + deviation * noise).clamp(-1.0, 1.0) as f32;
        }
        recorder.advance(&action);
    }
}
