//! A saved policy, and the episodes that it is to be scored on.

use std::path::{Path, PathBuf};
use std::{fs, io};

use quad_dataset::EnvironmentSpec;
use quad_dataset::environment::{self, UnknownEnvironment};
use quad_policy::{Policy, PolicyError, Precision, load_policy};
use quad_protocol::{Hash, Origin, OriginError};
use quad_service::Hint;
use tracing::warn;

use super::ScoreArgs;
use crate::environment::{EnvironmentError, make};

/// Most episodes, and most candidates per state: far above any use, low enough for memory.
pub const MOST_EPISODES: i64 = 10_000;
/// See [`MOST_EPISODES`].
pub const MOST_CANDIDATES: i64 = 1_000;
/// The paper's number of episodes and of candidates, for a file that does not say its run's.
const PAPER: u32 = 10;

const ONE: &str =
    "what can be scored is a file like RUN/snapshots/step_000020000.safetensors, as `learner train` writes them";
const NO_ORIGIN: &str = "an earlier `learner` wrote it; say --env NAME and --seed N, which RUN/config.toml has";

/// A saved policy, ready to act, and how it is to be scored.
pub struct Subject {
    /// The file.
    pub path: PathBuf,
    /// Its hash.
    pub weights: Hash,
    /// The policy.
    pub policy: Box<dyn Policy>,
    /// Arithmetic of its networks.
    pub precision: Precision,
    /// Where it acts.
    pub spec: &'static EnvironmentSpec,
    /// What its episodes follow from, with `step`.
    pub seed: u64,
    /// Gradient step that it was saved after; absent if the file does not say.
    pub step: Option<u64>,
    /// How many episodes.
    pub episodes: u32,
    /// Numbers of candidates to try.
    pub candidates: Vec<u32>,
}

/// A file that cannot be scored.
#[derive(Debug, thiserror::Error)]
pub enum SubjectError {
    /// It cannot be read.
    #[error("cannot read {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
    /// It is no policy.
    #[error("{path} is not a saved policy")]
    Policy {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: PolicyError,
    },
    /// What it says of its origin is nonsense.
    #[error("{path} is not a snapshot of a run")]
    Origin {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: OriginError,
    },
    /// An earlier learner saved it.
    #[error("{0} does not say which environment and which run it is from")]
    NoOrigin(PathBuf),
    /// It names an environment that nobody knows here.
    #[error("{path} is a policy for another environment")]
    Environment {
        /// The file.
        path: PathBuf,
        /// Its name.
        source: UnknownEnvironment,
    },
    /// The environment cannot be simulated here.
    #[error("{path} cannot be scored here")]
    Simulation {
        /// The file.
        path: PathBuf,
        /// Why.
        source: EnvironmentError,
    },
    /// A policy for another environment.
    #[error(
        "{path} turns {found:?} observed numbers into actions of {environment}, which has {wanted:?} (observation, action)"
    )]
    Sizes {
        /// The file.
        path: PathBuf,
        /// The environment.
        environment: String,
        /// The policy's sizes.
        found: (usize, usize),
        /// The environment's.
        wanted: (usize, usize),
    },
    /// Its numbers of episodes or candidates are not what a learner writes.
    #[error("{path} asks for {episodes} episodes with {candidates} candidates")]
    Range {
        /// The file.
        path: PathBuf,
        /// Episodes.
        episodes: u32,
        /// Candidates.
        candidates: u32,
    },
    /// Several candidates for a policy that samples none.
    #[error("{path} is a {kind} policy, which samples no candidates")]
    SamplesNone {
        /// The file.
        path: PathBuf,
        /// Its kind.
        kind: &'static str,
    },
}

impl Subject {
    /// Reads a file, and finds out what the command line leaves to it.
    pub fn read(path: &Path, args: &ScoreArgs) -> anyhow::Result<Self> {
        let file = fs::read(path).map_err(|source| SubjectError::Io { path: path.into(), source }).hint(ONE)?;
        let precision = args.precision.unwrap_or(Precision::Bf16);
        let policy = load_policy(&file, precision)
            .map_err(|source| SubjectError::Policy { path: path.into(), source })
            .hint(ONE)?;
        let origin =
            Origin::read(&file).map_err(|source| SubjectError::Origin { path: path.into(), source }).hint(ONE)?;

        let environment = match (args.env, &origin) {
            (Some(spec), _) => Ok(spec),
            (None, Some(origin)) => environment::find(&origin.environment)
                .map_err(|source| SubjectError::Environment { path: path.into(), source })
                .hint("--env NAME makes it act in another environment"),
            (None, None) => Err(SubjectError::NoOrigin(path.into())).hint(NO_ORIGIN),
        };
        let spec = environment?;
        let seed = args.seed.or(origin.as_ref().map(|origin| origin.seed));
        let seed = seed.ok_or_else(|| SubjectError::NoOrigin(path.into())).hint(NO_ORIGIN)?;
        let paper = if policy.samples_candidates() { PAPER } else { 1 };
        let (episodes, candidates) =
            origin.as_ref().map_or((PAPER, paper), |origin| (origin.episodes, origin.candidates));
        let subject = Self {
            path: path.into(),
            weights: Hash::of(&file),
            policy,
            precision: precision.in_effect(),
            spec,
            seed,
            step: origin.map(|origin| origin.step),
            episodes: args.episodes.unwrap_or(episodes),
            candidates: if args.candidates.is_empty() { vec![candidates] } else { args.candidates.clone() },
        };
        subject.check()?;
        if subject.step.is_none() {
            let Self { seed, episodes, candidates, .. } = &subject;
            warn!(
                "{}: scored on {episodes} episodes of seed {seed}, as if it were of step 0, with {candidates:?} candidates",
                path.display()
            );
        }
        Ok(subject)
    }

    fn check(&self) -> anyhow::Result<()> {
        let path = self.path.clone();
        let environment = self.spec.name.clone();
        let found = (self.policy.observation_dim(), self.policy.action_dim());
        let wanted = (self.spec.observation_dim, self.spec.action_dim);
        if found != wanted {
            return Err(SubjectError::Sizes { path, environment, found, wanted })
                .hint("--env NAME says where it is to act");
        }
        if let Err(source) = make(self.spec, self.seed) {
            return Err(SubjectError::Simulation { path, source })
                .hint("--env NAME makes it act in another environment");
        }
        let episodes = self.episodes;
        for &candidates in &self.candidates {
            if !(1..=MOST_EPISODES).contains(&episodes.into()) || !(1..=MOST_CANDIDATES).contains(&candidates.into()) {
                return Err(SubjectError::Range { path, episodes, candidates })
                    .hint("--episodes and --candidates take the place of what the file says");
            }
            if candidates > 1 && !self.policy.samples_candidates() {
                return Err(SubjectError::SamplesNone { path, kind: self.policy.kind() })
                    .hint("score it without --candidates");
            }
        }
        Ok(())
    }
}
