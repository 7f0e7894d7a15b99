//! Messages that tests make up, and a client that sends them: well-formed, but no learner or
//! evaluator of ours has sent them.

use std::time::{Duration, Instant};

use quad_dataset::environment;
use quad_protocol::{
    Episode, EpisodeScore, Hash, Job, JobReply, JobRequest, Message, Name, Piece, PieceReply,
    Progress, ScoreReport, decode, encode, keys,
};
use quad_runtime::{Endpoints, open_session};
use tokio::time::sleep;
use zenoh::Session;
use zenoh::query::{ConsolidationMode, QueryTarget};

use crate::PATIENCE;

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

/// Scores of all episodes of a job, as if a policy had run them.
pub fn scores(job: &Job, evaluator: &str) -> ScoreReport {
    let hopper = environment::find("hopper").expect("hopper is known");
    let episodes = job.seeds.iter().map(|&seed| {
        let episode_return = (seed % 3000) as f64;
        EpisodeScore {
            seed,
            episode_return,
            length: 300,
            score: hopper.normalized_score(episode_return),
        }
    });
    ScoreReport::new(job, name(evaluator), name("f32"), episodes.collect())
}

/// An online episode in Hopper, of 1,000 steps.
fn episode(job: &Job) -> Episode {
    let hopper = environment::find("hopper").expect("hopper is known");
    let (steps, reward) = (1000, 2.0);
    let episode_return = steps as f64 * f64::from(reward);
    let score = hopper.normalized_score(episode_return);
    let seed = job.seeds[0];
    Episode {
        score: EpisodeScore { seed, episode_return, length: steps as u32, score },
        observations: vec![0.1; (steps + 1) * 11],
        actions: vec![0.1; steps * 3],
        rewards: vec![reward; steps],
        ..Episode::new(job.step, job.weights, name("f32"), seed)
    }
}

pub async fn client(endpoint: &str) -> Session {
    let endpoints = Endpoints { connect: vec![endpoint.to_owned()], ..Endpoints::default() };
    open_session(&endpoints).await.expect("the endpoint is open")
}

/// The first answer; nothing if none came, or an error.
pub async fn ask<A: Message>(session: &Session, key: String, question: &impl Message) -> Option<A> {
    let get = session.get(key).payload(encode(question).expect("it is small")).timeout(PATIENCE);
    let get = get.target(QueryTarget::All).consolidation(ConsolidationMode::None).await;
    let answer = get.expect("the session is open").recv_async().await.ok()?.into_result().ok()?;
    Some(decode(&answer.payload().to_bytes()).expect("the learner's answer"))
}

/// Claims a job of a run until there is one.
pub async fn claim_eventually(session: &Session, run: &Name, evaluator: &str) -> Job {
    let begin = Instant::now();
    loop {
        if let Some(JobReply::Job(job)) =
            ask(session, keys::jobs(run), &claim(evaluator, 1, "hopper")).await
        {
            return job;
        }
        assert!(begin.elapsed() < PATIENCE, "no job for {evaluator}");
        sleep(Duration::from_millis(50)).await;
    }
}

/// Delivers an online episode, as if the job's policy had played it. Returns the last answer.
pub async fn deliver_experience(session: &Session, job: &Job, evaluator: &str) -> PieceReply {
    let frame = encode(&episode(job)).expect("it is small");
    let mut piece = Piece {
        evaluator: name(evaluator),
        run: job.run.clone(),
        incarnation: job.incarnation,
        job: job.id,
        seed: job.seeds[0],
        hash: Hash::new(&frame),
        length: frame.len() as u32,
        offset: 0,
        bytes: Vec::new(),
    };
    loop {
        let rest = &frame[piece.offset as usize..];
        piece.bytes = rest[..rest.len().min(Piece::MOST)].to_vec();
        match ask(session, keys::experience(&job.run), &piece).await {
            Some(PieceReply::Continue { offset, .. }) => piece.offset = offset,
            Some(answer) => return answer,
            None => sleep(Duration::from_millis(50)).await,
        }
    }
}
