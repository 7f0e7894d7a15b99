//! The networks of a snapshot, and what its run's settings say about values.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use quad_dataset::Normalize;
use quad_nn::{Ensemble, NoisePredictor};
use quad_policy::{
    Choice, Chunk, DiffusionPolicy, Header, PolicyConfig, PolicyError, Precision, read_tensors,
};
use quad_protocol::Origin;
use quad_run::files;
use quad_run::folder::RunDir;
use quad_runtime::Hint;

use super::args::ProbeArgs;
use super::oracle::Oracle;
use crate::tools::film;
use crate::tools::score::Subject;

const OTHERS: &str =
    "probe a run of `--algorithm quad`, with any guidance, without --normalize, chunks and history";

pub struct Probed {
    /// The policy as it is evaluated, which visits the states.
    pub subject: Subject,
    /// Values of the policy that the critics' targets evaluate, which takes its first sample.
    pub oracle: Oracle,
    pub actor: NoisePredictor,
    pub critics: Ensemble,
    /// τ and δ of Eq. 24.
    pub tau: f64,
    pub delta: f64,
    pub dataset: PathBuf,
}

impl Probed {
    pub fn read(args: &ProbeArgs) -> anyhow::Result<Self> {
        let name = args.run.display();
        let (_, config) = RunDir::open(&args.run).hint("pass the folder of a run")?;
        let subject = film::subject(&args.run, Some(args.step))?;
        let (experiment, data) = (config.experiment, config.dataset);
        let number = |key: &str| {
            let value = experiment.agent.get(key).and_then(|value| {
                value.as_float().or(value.as_integer().map(|number| number as f64))
            });
            value.with_context(|| format!("{name} has no agent.{key}")).hint(OTHERS)
        };
        if experiment.normalize != Normalize::default() {
            return Err(anyhow!("{name} has normalized data")).hint(OTHERS);
        }
        // After a goal a new trajectory begins, so a maze has returns of 0, too.
        let returns = match subject.spec.maze {
            Some(_) => [0.0, 1.0],
            None => [data.min_return, data.max_return],
        };
        let rewards = experiment.reward.scaling(&returns);
        let rewards = rewards.with_context(|| format!("all returns of {name} are the same"))?;

        let path = &subject.path;
        let file = files::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let header = Header::<Origin>::read(&file).hint_of(PolicyError::hint)?;
        let PolicyConfig::Diffusion { shape, .. } = header.policy else {
            return Err(anyhow!("{name} has no diffusion policy")).hint(OTHERS);
        };
        if header.chunk != Chunk::default() {
            return Err(anyhow!("{name} acts for several steps at a time")).hint(OTHERS);
        }
        let tensors = &mut read_tensors(&file)?;
        let (actor, critics) = DiffusionPolicy::networks(&shape, tensors, Precision::F32)?;
        let critics = critics.with_context(|| format!("{name} has no critics")).hint(OTHERS)?;
        let oracle = Oracle {
            spec: subject.spec,
            policy: subject.policy.with_choice(Choice::best_of(1))?,
            rewards,
            gamma: number("gamma")?,
            length: args.length,
        };
        Ok(Self {
            subject,
            oracle,
            actor,
            critics,
            tau: number("tau")?,
            delta: number("delta")?,
            dataset: data.path,
        })
    }
}
