//! Messages that tests make up, and a client that sends them: well-formed, but no learner or
//! evaluator of ours has sent them.

use quad_protocol::{EpisodeScore, Hash, JobRequest, Name, Progress, ScoreReport};
use quad_runtime::{Endpoints, open_session};
use zenoh::Session;
use zenoh::qos::CongestionControl;

pub fn name(text: &str) -> Name {
    Name::new(text).expect("an allowed name")
}

pub fn claim(evaluator: &str, attempt: u64, environment: &str) -> JobRequest {
    JobRequest::Claim {
        evaluator: name(evaluator),
        attempt,
        environments: vec![environment.to_owned()],
    }
}

/// Progress of a job that was never handed out.
pub fn progress(run: &Name, evaluator: &str, steps_done: u64) -> Progress {
    Progress {
        evaluator: name(evaluator),
        run: run.clone(),
        incarnation: 1,
        job: 1,
        episodes_done: 0,
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
        weights: Hash::new(b"guessed"),
        precision: name("f32"),
        episodes: vec![EpisodeScore { seed, episode_return: f64::NAN, length: 0, score: f64::NAN }],
    }
}

pub async fn client(endpoint: &str) -> Session {
    let endpoints = Endpoints { connect: vec![endpoint.to_owned()], ..Endpoints::default() };
    open_session(&endpoints).await.expect("the endpoint is open")
}

/// Puts, where a busy machine would else drop the message.
pub async fn put(session: &Session, key: &str, payload: &[u8]) {
    let put = session.put(key, payload).congestion_control(CongestionControl::Block);
    put.await.expect("the session is open");
}
