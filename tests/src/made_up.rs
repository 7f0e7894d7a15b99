//! Messages that tests make up: well-formed, but no learner or evaluator of ours has sent them.

use quad_protocol::{EpisodeScore, Hash, JobRequest, Name, Progress, ScoreReport, Snapshot};

/// A name that is allowed.
pub fn name(text: &str) -> Name {
    Name::new(text).expect("an allowed name")
}

/// Asks for work in one environment.
pub fn claim(evaluator: &str, attempt: u64, environment: &str) -> JobRequest {
    JobRequest::Claim { evaluator: name(evaluator), attempt, environments: vec![environment.to_owned()] }
}

/// Tells of a job that was never handed out.
pub fn progress(run: &Name, evaluator: &str, steps_done: u64) -> Progress {
    Progress {
        evaluator: name(evaluator),
        run: run.clone(),
        incarnation: 1,
        job: 1,
        step: 10,
        episodes_done: 0,
        episodes_total: 5,
        steps_done,
        environment_steps: steps_done,
        episodes: 0,
    }
}

/// A return that is not a number, of weights whose hash was guessed.
pub fn report(run: &Name, step: u64, seed: u64) -> ScoreReport {
    ScoreReport {
        evaluator: name("liar"),
        run: run.clone(),
        incarnation: 1,
        job: 1,
        step,
        weights: Hash::of(b"guessed"),
        precision: name("f32"),
        episodes: vec![EpisodeScore { seed, episode_return: f64::NAN, length: 0, score: f64::NAN }],
    }
}

/// A snapshot, whatever is in its file.
pub fn snapshot(run: &Name, incarnation: u64, step: u64, file: &[u8]) -> Snapshot {
    Snapshot { run: run.clone(), incarnation, step, hash: Hash::of(file), file: file.to_vec() }
}
