//! A saved policy, and the episodes to score it on.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_dataset::EnvironmentSpec;
use quad_dataset::environment;
use quad_policy::{Choice, Header, Policy, load_policy};
use quad_protocol::{Hash, Origin};
use quad_run::files;
use quad_runtime::Hint;

use super::args::{MOST_EPISODES, ScoreArgs};
use crate::sim::{Environment, EnvironmentError, EpisodeOutcome, Rollout};

const ONE: &str = "what can be scored is a file like RUN/snapshots/step_000020000.safetensors, as `learner train` of this \
                   version writes them";
const OTHER_ENVIRONMENT: &str =
    "in an environment of your own it acts from Python (docs/python.md)";
const OTHER_CHOICE: &str = "score it without --candidates, --rule and --value";
const RANGE: &str = "--episodes takes the place of what the file says";

/// A saved policy, ready to act, with its episodes.
pub struct Subject {
    /// The file.
    pub path: PathBuf,
    /// Its hash.
    pub weights: Hash,
    /// The policy.
    pub policy: Box<dyn Policy>,
    /// Its environment.
    pub spec: &'static EnvironmentSpec,
    /// Seed from which, with `step`, the episodes' seeds follow.
    pub seed: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Number of episodes.
    pub episodes: u32,
}

impl Subject {
    /// Reads a file, and takes from it what the command line does not say. Returns its policy once
    /// for each way to choose that the command line asks for.
    ///
    /// # Errors
    ///
    /// The file is no policy, or the policy cannot act in the environment or cannot choose in this
    /// way.
    pub fn read(path: &Path, args: &ScoreArgs) -> anyhow::Result<Vec<Self>> {
        let name = path.display();
        let file =
            files::read_named(path).with_context(|| format!("cannot read {name}")).hint(ONE)?;
        let policy = load_policy(&file, args.precision);
        let policy = policy.with_context(|| format!("{name} is not a saved policy")).hint(ONE)?;
        let header = Header::read(&file)
            .with_context(|| format!("{name} is not a snapshot of a run"))
            .hint(ONE)?;
        let Origin { environment, seed, step, episodes } = header.origin;
        let spec = match args.env {
            Some(spec) => spec,
            None => environment::find(&environment)
                .with_context(|| format!("{name} is a policy for another environment"))
                .hint(OTHER_ENVIRONMENT)?,
        };
        let (weights, path) = (Hash::of(&file), path.to_owned());
        let (seed, episodes) = (args.seed.unwrap_or(seed), args.episodes.unwrap_or(episodes));
        let subject = Self { path: path.clone(), weights, policy, spec, seed, step, episodes };
        subject.check()?;
        let choices = choices(args, subject.policy.choice());
        if choices.is_empty() {
            return Ok(vec![subject]);
        }
        let choosing = |choice| {
            let policy = subject.policy.with_choice(choice);
            let policy =
                policy.with_context(|| format!("{name} cannot be scored so")).hint(OTHER_CHOICE)?;
            Ok(Self { path: path.clone(), weights, policy, spec, seed, step, episodes })
        };
        choices.into_iter().map(choosing).collect()
    }

    /// Plays the episodes of some seeds as one batch, in environments that `make` makes.
    ///
    /// # Errors
    ///
    /// The policy cannot act.
    pub fn roll_out(
        &self,
        make: impl FnMut() -> Result<Box<dyn Environment>, EnvironmentError>,
        seeds: &[u64],
    ) -> anyhow::Result<Vec<EpisodeOutcome>> {
        let Self { path, policy, .. } = self;
        let sizes = (policy.observation_dim(), policy.action_dim());
        let mut rollout = Rollout::new(make, sizes, seeds, |seed| policy.begin(seed))?;
        while !rollout.is_done() {
            rollout.step(|observations, states, actions| {
                let acted = policy.act(observations, states, actions);
                acted.with_context(|| format!("{}: the policy cannot act", path.display()))
            })?;
        }
        Ok(rollout.into_outcomes())
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
        if !(1..=MOST_EPISODES).contains(&episodes.into()) {
            return Err(anyhow!("{name} asks for {episodes} episodes")).hint(RANGE);
        }
        Ok(())
    }
}

/// The ways to choose that the command line asks for, completed from the policy's `own`. None if it
/// asks for none.
fn choices(args: &ScoreArgs, own: Option<Choice>) -> Vec<Choice> {
    let own = own.unwrap_or(Choice::best_of(1));
    let of = |candidates| Choice {
        candidates,
        rule: args.rule.unwrap_or(own.rule),
        value: args.value.unwrap_or(own.value),
    };
    match args.candidates.as_slice() {
        [] if args.rule.is_none() && args.value.is_none() => Vec::new(),
        [] => vec![of(own.candidates)],
        several => several.iter().copied().map(of).collect(),
    }
}

#[cfg(test)]
mod tests {
    use quad_policy::{Aggregate, Rule};

    use super::*;

    #[test]
    fn what_the_command_line_does_not_say_is_as_the_policy_has_it() {
        let own = Choice { value: Aggregate::Min, ..Choice::best_of(7) };
        let rule = Rule::Softmax { temperature: 0.5 };
        assert!(choices(&ScoreArgs::default(), Some(own)).is_empty());
        let asked = ScoreArgs { rule: Some(rule), ..ScoreArgs::default() };
        assert_eq!(choices(&asked, Some(own)), [Choice { rule, ..own }]);
        let asked = ScoreArgs { candidates: vec![1, 10], ..ScoreArgs::default() };
        assert_eq!(
            choices(&asked, Some(own)),
            [1, 10].map(|candidates| Choice { candidates, ..own })
        );
    }
}
