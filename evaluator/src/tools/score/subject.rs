//! A saved policy, and the episodes to score it on.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_dataset::environment::{self, EnvironmentSpec};
use quad_policy::{Choice, Header, Policy, PolicyConfig, PolicyError, load_policy};
use quad_protocol::{EpisodeScore, Hash, Origin};
use quad_run::files;
use quad_runtime::Hint;

use super::args::{MOST_EPISODES, ScoreArgs};
use crate::sim::{self, Environment, EnvironmentError, Rollout, Simulation};

const SNAPSHOT: &str = "pass files like RUN/snapshots/step_000020000.safetensors; \
                        RUN/snapshots/*.safetensors are all of a run";
const OTHER_ENVIRONMENT: &str = "in your own environment, run it from Python (docs/python.md)";

/// A saved policy, ready to act, with its episodes.
pub struct Subject {
    pub path: PathBuf,
    /// Hash of the file.
    pub weights: Hash,
    pub policy: Box<dyn Policy>,
    pub spec: &'static EnvironmentSpec,
    /// Seed from which, with `step`, the episodes' seeds follow.
    pub seed: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    pub episodes: u32,
    /// The run and the algorithm, in an exported policy.
    pub origin: Option<[String; 2]>,
}

impl Subject {
    /// Reads a file, whose values the command line's options replace. Returns its policy once for
    /// each way to choose that the command line asks for.
    pub fn read(path: &Path, args: &ScoreArgs) -> anyhow::Result<Vec<Self>> {
        let name = path.display();
        let file = files::read_named(path)
            .with_context(|| format!("cannot read {name}"))
            .hint(SNAPSHOT)?;
        let policy = load_policy(&file, args.precision)
            .hint_of(PolicyError::hint)
            .with_context(|| format!("{name} is not a saved policy"))?;
        let header = Header::read(&file)
            .hint_of(PolicyError::hint)
            .with_context(|| format!("{name} is not a snapshot of a run"))?;
        let origin: Origin = header.origin;
        let spec = args.env.map_or_else(|| environment::find(&origin.environment), Ok);
        let spec = spec
            .with_context(|| format!("{name} is a policy for another environment"))
            .hint(OTHER_ENVIRONMENT)?;
        let weights = Hash::new(&file);
        let about = |key: &str| header.about[key].as_str().map(str::to_owned);
        let exported = about("run").zip(about("algorithm")).map(<[String; 2]>::from);
        let subject = |policy| Self {
            path: path.to_owned(),
            weights,
            policy,
            spec,
            seed: args.seed.unwrap_or(origin.seed),
            step: origin.step,
            episodes: args.episodes.unwrap_or(origin.episodes),
            origin: exported.clone(),
        };
        let unchanged = subject(policy);
        unchanged.check()?;
        let choices = choices(args, unchanged.policy.choice());
        if choices.is_empty() {
            return Ok(vec![unchanged]);
        }
        let with_choice = |choice| {
            let policy = unchanged.policy.with_choice(choice);
            let policy = policy.hint_of(PolicyError::hint);
            let cannot = || format!("{name} cannot choose actions this way");
            policy.with_context(cannot).map(subject)
        };
        let subjects = choices.into_iter().map(with_choice).collect::<anyhow::Result<Vec<_>>>()?;
        let chooses =
            |subject: &Self| subject.policy.choice().is_some_and(|choice| choice.candidates > 1);
        if (args.rule.is_some() || args.aggregate.is_some()) && !subjects.iter().any(chooses) {
            let nothing = "samples one action per state, so --rule and --aggregate change nothing";
            return Err(anyhow!("{name} {nothing}"))
                .hint("take more --candidates, or leave them out");
        }
        if args.aggregate.is_some() && has_one_critic(&header.policy) {
            return Err(anyhow!("{name} has one critic, so --aggregate changes nothing"))
                .hint("leave it out");
        }
        Ok(subjects)
    }

    /// The environment of the scored episodes.
    fn simulation(&self) -> Result<Simulation, EnvironmentError> {
        sim::make(self.spec, self.seed)
    }

    /// Plays the episodes of some seeds as one batch.
    pub fn roll_out(&self, seeds: &[u64]) -> anyhow::Result<Vec<EpisodeScore>> {
        let policy = &*self.policy;
        let make = || Ok(Box::new(self.simulation()?) as Box<dyn Environment>);
        let sizes = (policy.observation_dim(), policy.action_dim());
        let mut rollout = Rollout::new(make, sizes, seeds, |seed| policy.begin(seed))?;
        while !rollout.is_done() {
            rollout.step(|observations, states, actions| {
                policy.act(observations, states, actions).with_context(|| self.cannot_act())
            })?;
        }
        Ok(rollout.into_scores())
    }

    pub fn cannot_act(&self) -> String {
        format!("{}: the policy cannot act", self.path.display())
    }

    fn check(&self) -> anyhow::Result<()> {
        let (name, environment, episodes) = (self.path.display(), &self.spec.name, self.episodes);
        let sizes = (self.policy.observation_dim(), self.policy.action_dim());
        let expected = (self.spec.observation_dim, self.spec.action_dim);
        if sizes != expected {
            return Err(anyhow!(
                "{name} has the sizes {sizes:?} (observation, action), but {environment} has {expected:?}"
            ))
            .hint("choose its environment with --env NAME");
        }
        if !(1..=MOST_EPISODES).contains(&episodes.into()) {
            return Err(anyhow!("{name} asks for {episodes} episodes"))
                .hint("set their number with --episodes");
        }
        Ok(())
    }
}

/// The ways to choose that the command line asks for, completed from the policy's own; empty if it
/// asks for none.
fn choices(args: &ScoreArgs, own: Option<Choice>) -> Vec<Choice> {
    let own = own.unwrap_or(Choice::best_of(1));
    let rule = args.rule.unwrap_or(own.rule);
    let aggregate = args.aggregate.unwrap_or(own.aggregate);
    let guidance = args.guidance.unwrap_or(own.guidance);
    let with = |candidates| Choice { candidates, rule, aggregate, guidance };
    let asked = args.rule.is_some() || args.aggregate.is_some() || args.guidance.is_some();
    match args.candidates.as_slice() {
        [] if !asked => Vec::new(),
        [] => vec![with(own.candidates)],
        several => once_each(several).copied().map(with).collect(),
    }
}

/// The values without later duplicates, which a table has no place for.
pub fn once_each<T: Ord>(values: &[T]) -> impl Iterator<Item = &T> {
    let mut seen = BTreeSet::new();
    values.iter().filter(move |value| seen.insert(*value))
}

fn has_one_critic(policy: &PolicyConfig) -> bool {
    match policy {
        PolicyConfig::Diffusion { shape, .. } => shape.critics == 1,
        PolicyConfig::Squashed { shape, .. }
        | PolicyConfig::OneStep { shape, .. }
        | PolicyConfig::Flow { shape, .. } => shape.critics == 1,
        PolicyConfig::Score { .. } | PolicyConfig::Diffuser { .. } => true,
        PolicyConfig::Gaussian { .. } => false,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use quad_policy::{Aggregate, DiffusionShape, MlpConfig};
    use quad_protocol::episode_seeds;

    use super::super::measure;
    use super::*;
    use crate::serve::fixtures::{file, smallest};

    fn read(
        environment: &str,
        shape: DiffusionShape,
        args: &ScoreArgs,
    ) -> anyhow::Result<Vec<Subject>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("policy.safetensors");
        fs::write(&path, file(environment, shape, 1)).unwrap();
        Subject::read(&path, args)
    }

    #[test]
    fn options_replace_the_file_s_episodes_in_the_run_s_environment() {
        let args = ScoreArgs { seed: Some(9), episodes: Some(1), ..ScoreArgs::default() };
        let scored = measure(&read("hopper", smallest(), &args).unwrap()[0]).unwrap();
        assert_eq!([scored.episodes[0].seed], episode_seeds(9, scored.step, 1)[..]);
        assert_eq!(scored.episodes.len(), 1);
        let shape = DiffusionShape::quad((29, 8), &MlpConfig::mish(&[1]), 1, 1);
        let ant = &read("antmaze-umaze-v0", shape, &ScoreArgs::default()).unwrap()[0];
        let [scored, trained] = [ant.simulation(), sim::make(ant.spec, 1)].map(Result::unwrap);
        assert_eq!(scored.goal(), trained.goal());
    }

    #[test]
    fn a_choice_that_changes_nothing_is_refused() {
        let (mean, min) = (Aggregate::Mean, Aggregate::Min);
        for (critics, candidates, aggregate, expected) in [
            (0, &[][..], min, "no critics"),
            (0, &[], mean, "one action per state"),
            (0, &[1, 10], mean, "no critics"),
            (2, &[], min, "one action per state"),
            (2, &[1], min, "one action per state"),
            (1, &[1, 10], min, "one critic"),
            (2, &[1, 10], min, ""),
        ] {
            let candidates = candidates.to_vec();
            let args = ScoreArgs { candidates, aggregate: Some(aggregate), ..Default::default() };
            let error = read("hopper", DiffusionShape { critics, ..smallest() }, &args).err();
            let problem = error.map_or_else(String::new, |error| format!("{error:#}"));
            let fits = problem.contains(expected) && problem.is_empty() == expected.is_empty();
            assert!(fits, "{critics} critics, {:?}: {problem:?}", args.candidates);
        }
    }
}
