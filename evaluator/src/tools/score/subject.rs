//! A saved policy, and the episodes that it is to be scored on.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_dataset::EnvironmentSpec;
use quad_dataset::environment;
use quad_policy::{Policy, Precision, load_policy};
use quad_protocol::{Hash, Origin};
use quad_service::Hint;
use tracing::warn;

use super::args::{MOST_CANDIDATES, MOST_EPISODES, ScoreArgs};
use crate::sim;

/// The paper's number of episodes and of candidates, for a file that does not say its run's.
const PAPER: u32 = 10;

const ONE: &str =
    "what can be scored is a file like RUN/snapshots/step_000020000.safetensors, as `learner train` writes them";
const NO_ORIGIN: &str = "an earlier `learner` wrote it; say --env NAME and --seed N, which RUN/config.toml has";
const OTHER_ENVIRONMENT: &str = "--env NAME makes it act in another environment";
const RANGE: &str = "--episodes and --candidates take the place of what the file says";

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

impl Subject {
    /// Reads a file, and takes from it what the command line does not say.
    ///
    /// # Errors
    ///
    /// The file is no policy, or one that cannot act in the environment.
    pub fn read(path: &Path, args: &ScoreArgs) -> anyhow::Result<Self> {
        let name = path.display();
        let file = fs::read(path).with_context(|| format!("cannot read {name}")).hint(ONE)?;
        let precision = args.precision.unwrap_or(Precision::Bf16);
        let policy =
            load_policy(&file, precision).with_context(|| format!("{name} is not a saved policy")).hint(ONE)?;
        let origin = Origin::read(&file).with_context(|| format!("{name} is not a snapshot of a run")).hint(ONE)?;
        let no_origin = || anyhow!("{name} does not say which environment and which run it is from");

        let spec = match (args.env, &origin) {
            (Some(spec), _) => spec,
            (None, Some(origin)) => environment::find(&origin.environment)
                .with_context(|| format!("{name} is a policy for another environment"))
                .hint(OTHER_ENVIRONMENT)?,
            (None, None) => return Err(no_origin()).hint(NO_ORIGIN),
        };
        let seed = args.seed.or(origin.as_ref().map(|origin| origin.seed));
        let seed = seed.ok_or_else(no_origin).hint(NO_ORIGIN)?;
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
                "{name}: scored on {episodes} episodes of seed {seed}, as if it were of step 0, with {candidates:?} candidates"
            );
        }
        Ok(subject)
    }

    fn check(&self) -> anyhow::Result<()> {
        let (name, environment, episodes) = (self.path.display(), &self.spec.name, self.episodes);
        let found = (self.policy.observation_dim(), self.policy.action_dim());
        let wanted = (self.spec.observation_dim, self.spec.action_dim);
        if found != wanted {
            let error = anyhow!(
                "{name} turns {found:?} observed numbers into actions of {environment}, which has {wanted:?} \
                 (observation, action)"
            );
            return Err(error).hint("--env NAME says where it is to act");
        }
        let simulated = sim::make(self.spec, self.seed).with_context(|| format!("{name} cannot be scored here"));
        simulated.hint(OTHER_ENVIRONMENT)?;
        for &candidates in &self.candidates {
            if !(1..=MOST_EPISODES).contains(&episodes.into()) || !(1..=MOST_CANDIDATES).contains(&candidates.into()) {
                return Err(anyhow!("{name} asks for {episodes} episodes with {candidates} candidates")).hint(RANGE);
            }
            if candidates > 1 && !self.policy.samples_candidates() {
                let kind = self.policy.kind();
                return Err(anyhow!("{name} is a {kind} policy, which samples no candidates"))
                    .hint("score it without --candidates");
            }
        }
        Ok(())
    }
}
