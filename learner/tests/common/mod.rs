//! What made-up evaluators send.

use quad_protocol::{EpisodeScore, Job, Name, Progress, ScoreReport};

pub fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// An episode of Hopper.
pub fn score(seed: u64, episode_return: f64) -> EpisodeScore {
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    EpisodeScore { seed, episode_return, length: 100, score: hopper.normalised_score(episode_return) }
}

/// Some of a job's scores.
pub fn report(job: &Job, evaluator: &str, episodes: Vec<EpisodeScore>) -> ScoreReport {
    ScoreReport::of(job, name(evaluator), name("f32"), episodes)
}

/// All of them.
pub fn full_report(job: &Job, evaluator: &str) -> ScoreReport {
    report(job, evaluator, job.seeds.iter().map(|&seed| score(seed, 500.0)).collect())
}

/// Of so many environment steps, with its proof.
pub fn progress(job: &Job, evaluator: &str, steps_done: u64) -> Progress {
    Progress { steps_done, environment_steps: 10, episodes: 1, ..Progress::of(job, name(evaluator)) }.signed(&job.lease)
}
