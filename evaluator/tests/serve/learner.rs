//! A learner that has one job and writes down what an evaluator says; and the evaluator's process.

use std::process::{Child, Command, ExitStatus};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use candle_core::Device;
use quad_nn::Weights;
use quad_policy::{Choice, DiffusionShape, Header, MlpConfig, PolicyConfig};
use quad_protocol::{
    Hash, Job, JobReply, JobRequest, Message, Name, Origin, ScoreReply, ScoreReport, Snapshot,
    decode, encode, keys,
};
use quad_runtime::{Endpoints, open_session, reachable_at};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use zenoh::liveliness::LivelinessToken;
use zenoh::query::Query;
use zenoh::{Session, Wait};

const PATIENCE: Duration = Duration::from_secs(120);
const INCARNATION: u64 = 7;

/// What an evaluator has said.
#[derive(Clone, Debug, PartialEq)]
pub enum Heard {
    /// With its number.
    Claim(u64),
    Weights,
    Progress,
    Scores(ScoreReport),
    HandedBack(Option<String>),
}

/// What becomes of scores, and of claims.
#[derive(Clone, Copy)]
pub enum Answer {
    Recorded,
    DiskFull,
    Nothing,
    /// The learner reads nothing more, as long as this is the answer.
    Hang,
    /// No claim is answered.
    NoClaim,
    Refused,
    /// The first time that a job is handed back goes without an answer, as if the learner were too
    /// busy for it.
    LostHandBack,
}

/// A learner that has one job.
pub struct Learner {
    pub session: Session,
    endpoint: String,
    pub heard: Arc<Mutex<Vec<Heard>>>,
    answer: Arc<Mutex<Answer>>,
    /// Given out until it is done or handed back.
    job: Arc<Mutex<Option<Job>>>,
    pub snapshot: Snapshot,
}

/// The file of a small diffusion policy for Hopper with random weights, which takes the best of so
/// many candidates.
pub fn file(candidates: u32) -> Vec<u8> {
    let shape = DiffusionShape::quad((11, 3), &MlpConfig::mish(&[8; 3]), 2, 5);
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let policy = PolicyConfig::Diffusion { shape, choice: Choice::best_of(candidates) };
    let tensors =
        policy.tensors(|layout| Weights::initial(layout, &mut generator, &Device::Cpu)).unwrap();
    let origin = Origin { environment: "hopper".to_owned(), seed: 1, step: 10, episodes: 3 };
    Header::new(policy, origin).to_safetensors(&tensors).unwrap()
}

pub fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

pub fn snapshot(file: Vec<u8>) -> Snapshot {
    Snapshot { run: name("run"), incarnation: INCARNATION, step: 10, hash: Hash::of(&file), file }
}

pub fn job(snapshot: &Snapshot) -> Job {
    Job {
        id: 1,
        run: name("run"),
        incarnation: INCARNATION,
        step: 10,
        weights: snapshot.hash,
        environment: "hopper".to_owned(),
        environment_seed: 1,
        seeds: vec![11, 12, 13],
        progress_milliseconds: 100,
    }
}

fn reply<M: Message>(query: &Query, message: &M) {
    query.reply(query.key_expr().clone(), encode(message).unwrap()).wait().unwrap();
}

fn answer_scores(query: &Query, answer: &Mutex<Answer>, new: u32) {
    let now = *answer.lock().unwrap();
    match now {
        Answer::Recorded => {
            reply(query, &ScoreReply::Recorded { incarnation: INCARNATION, new, duplicates: 0 })
        }
        Answer::DiskFull => {
            // What a learner says that is not followed does not count, though it comes first.
            reply(query, &ScoreReply::Refused { incarnation: 99, reason: "not mine".to_owned() });
            query.reply_err("No space left on device").wait().unwrap();
        }
        Answer::Refused => {
            reply(
                query,
                &ScoreReply::Refused {
                    incarnation: INCARNATION,
                    reason: "they are of another sum".to_owned(),
                },
            );
        }
        Answer::Nothing | Answer::NoClaim | Answer::LostHandBack => {}
        Answer::Hang => {
            while matches!(*answer.lock().unwrap(), Answer::Hang) {
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

impl Learner {
    pub async fn start(published: Snapshot) -> Learner {
        let listen =
            Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
        let session = open_session(&listen).await.unwrap();
        let endpoint = reachable_at(&session, &listen).await.unwrap().remove(0);
        let (heard, answer) =
            (Arc::new(Mutex::new(Vec::new())), Arc::new(Mutex::new(Answer::Recorded)));
        let learner =
            Learner { session, endpoint, heard, answer, job: Arc::default(), snapshot: published };
        let (heard, job, answer, weights) = (
            learner.heard.clone(),
            learner.job.clone(),
            learner.answer.clone(),
            learner.snapshot.clone(),
        );
        let callback = move |query: Query| {
            let message =
                query.payload().map(|payload| payload.to_bytes().into_owned()).unwrap_or_default();
            let key = query.key_expr().as_str().to_owned();
            let mut heard = heard.lock().unwrap();
            if key == keys::weights_at(&name("run"), 10) {
                heard.push(Heard::Weights);
                reply(&query, &snapshot(b"other weights".to_vec()));
                reply(&query, &weights);
            } else if key == keys::scores(&name("run")) {
                let report: ScoreReport = decode(&message).unwrap();
                let new = report.episodes.len() as u32;
                heard.push(Heard::Scores(report));
                *job.lock().unwrap() = None;
                drop(heard);
                answer_scores(&query, &answer, new);
            } else {
                match decode(&message).unwrap() {
                    JobRequest::HandBack { failed, .. } => {
                        heard.push(Heard::HandedBack(failed));
                        *job.lock().unwrap() = None;
                        let mut answer = answer.lock().unwrap();
                        if matches!(*answer, Answer::LostHandBack) {
                            *answer = Answer::Recorded;
                        } else {
                            reply(
                                &query,
                                &JobReply::HandedBack { incarnation: INCARNATION, accepted: true },
                            );
                        }
                    }
                    JobRequest::Claim { attempt, .. } => {
                        heard.push(Heard::Claim(attempt));
                        let job = job.lock().unwrap().clone().map(JobReply::Job);
                        let wait = JobReply::Wait { incarnation: INCARNATION, milliseconds: 100 };
                        if !matches!(*answer.lock().unwrap(), Answer::NoClaim) {
                            reply(&query, &job.unwrap_or(wait));
                        }
                    }
                }
            }
        };
        let (told, progress) = (learner.heard.clone(), keys::all_progress(&name("run")));
        learner
            .session
            .declare_queryable("quad/run/**")
            .callback(callback)
            .background()
            .await
            .unwrap();
        let told = move |_| told.lock().unwrap().push(Heard::Progress);
        learner.session.declare_subscriber(progress).callback(told).background().await.unwrap();
        learner
    }

    pub fn answer(&self, answer: Answer) {
        *self.answer.lock().unwrap() = answer;
    }

    pub fn give(&self, job: Job) {
        *self.job.lock().unwrap() = Some(job);
    }

    /// Starts an evaluator and announces the learner; with it, one that is dead and was started
    /// before.
    pub async fn evaluator(&self) -> (Evaluator, impl Sized + use<>) {
        let (evaluator, token) = self.only_evaluator().await;
        (evaluator, (token, self.announce(INCARNATION - 1).await))
    }

    /// Starts an evaluator and announces the learner alone.
    pub async fn only_evaluator(&self) -> (Evaluator, impl Sized + use<>) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_evaluator"));
        command.args(["serve", "--name", "one", "--connect", &self.endpoint]);
        let evaluator = Evaluator(command.spawn().unwrap());
        (evaluator, self.announce(INCARNATION).await)
    }

    async fn announce(&self, incarnation: u64) -> LivelinessToken {
        let key = keys::live_learner(&name("run"), incarnation);
        self.session.liveliness().declare_token(key).await.unwrap()
    }

    pub async fn wait_for<T>(&self, what: impl Fn(&[Heard]) -> Option<T>) -> T {
        let begin = Instant::now();
        loop {
            if let Some(found) = what(&self.heard.lock().unwrap()) {
                return found;
            }
            assert!(begin.elapsed() < PATIENCE, "{:?}", self.heard.lock().unwrap());
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    pub async fn wait_for_scores(&self, deliveries: usize) -> ScoreReport {
        let nth = |heard: &[Heard]| reports(heard).into_iter().nth(deliveries - 1);
        self.wait_for(nth).await
    }

    pub fn count(&self, what: impl Fn(&Heard) -> bool) -> usize {
        self.heard.lock().unwrap().iter().filter(|heard| what(heard)).count()
    }
}

pub fn reports(heard: &[Heard]) -> Vec<ScoreReport> {
    let report =
        |heard: &Heard| if let Heard::Scores(report) = heard { Some(report.clone()) } else { None };
    heard.iter().filter_map(report).collect()
}

/// Why a job was handed back first, if one was.
pub fn handed_back(heard: &[Heard]) -> Option<Option<String>> {
    heard.iter().find_map(|heard| {
        if let Heard::HandedBack(failed) = heard { Some(failed.clone()) } else { None }
    })
}

pub struct Evaluator(Child);

impl Evaluator {
    /// Tells it to leave. If that takes longer than nine seconds, it ends itself with an error.
    pub fn leave(mut self) -> ExitStatus {
        // SAFETY: sends a signal to a process that this one has started and not waited for.
        assert_eq!(unsafe { libc::kill(self.0.id() as i32, libc::SIGTERM) }, 0);
        self.0.wait().unwrap()
    }
}

impl Drop for Evaluator {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}
