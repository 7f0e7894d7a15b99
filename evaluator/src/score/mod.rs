//! `evaluator score`: scores saved policies, on this machine alone.
//!
//! [`subject`] reads a policy and finds out which episodes are its own; [`table`] prints what they came to.

pub mod subject;
pub mod table;

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, value_parser};
use quad_dataset::EnvironmentSpec;
use quad_dataset::environment;
use quad_policy::{ActionNoise, Precision};
use quad_protocol::episode_seeds;
use rayon::prelude::*;
use serde::Serialize;
use tracing::{info, warn};

use crate::rollout::{EpisodeOutcome, Rollout};
use subject::Subject;

/// Episodes in a batch. It bounds memory; a larger batch is hardly faster.
const BATCH: usize = 16;

const AFTER_HELP: &str = "\
Examples:
  # The scores that the run has, measured again.
  evaluator score runs/mine/snapshots/step_000020000.safetensors

  # How much is owed to the choice among ten? The same hundred episodes, first without it, then with it.
  evaluator score runs/mine/snapshots/step_000020000.safetensors --episodes 100 --candidates 1,10

RAYON_NUM_THREADS bounds the processor cores that are used; without it, all are.";

/// Score saved policies on this machine alone: any snapshot of any run
///
/// A snapshot says which environment it is for and which episodes its run evaluates it on. Unless told otherwise, these are
/// what it is scored on, so it gets the scores that the run has of it (in the same arithmetic).
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct ScoreArgs {
    /// Files that learners have saved, e.g. runs/mine/snapshots/step_000020000.safetensors
    #[arg(value_name = "SNAPSHOT", required = true)]
    snapshots: Vec<PathBuf>,
    /// Episodes for each [default: as many as the run's]
    #[arg(long, value_name = "N", value_parser = value_parser!(u32).range(1..=subject::MOST_EPISODES))]
    episodes: Option<u32>,
    /// Actions sampled per state, of which the critics choose the best; several numbers, like 1,10, are scored on the same
    /// episodes [default: the run's]
    #[arg(long, value_name = "N,..", value_delimiter = ',', value_parser = value_parser!(u32).range(1..=subject::MOST_CANDIDATES))]
    candidates: Vec<u32>,
    /// Seed that the episodes follow from, with the snapshot's step [default: the run's]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Environment to act in [default: the run's]
    #[arg(long, value_name = "NAME", value_parser = environment::find)]
    env: Option<&'static EnvironmentSpec>,
    /// Arithmetic of the networks, f32 or bf16 [default: as `evaluator serve`]
    #[arg(long, value_name = "NAME")]
    precision: Option<Precision>,
    /// Print a JSON array with every episode
    #[arg(long)]
    json: bool,
}

/// What one policy came to with one number of candidates.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scored {
    /// The file.
    pub snapshot: PathBuf,
    /// BLAKE3 of the file.
    pub weights: String,
    /// Environment that it acted in.
    pub environment: String,
    /// Gradient step that it was saved after; absent if the file does not say.
    pub step: Option<u64>,
    /// Seed that the episodes follow from, with the step.
    pub seed: u64,
    /// Actions sampled per state.
    pub candidates: u32,
    /// Arithmetic of the networks, as in `scores.jsonl`.
    pub precision: String,
    /// In the order of their seeds.
    pub episodes: Vec<Episode>,
}

/// What one episode came to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Episode {
    /// Seed of its initial state and of the policy's noise.
    pub seed: u64,
    /// Sum of its rewards, undiscounted.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Its environment steps.
    pub length: u32,
    /// D4RL's normalised score.
    pub score: f64,
}

/// Scores what the command line names; gives what is to be printed.
///
/// # Errors
/// A file that is no policy of an environment that can be simulated here; nothing is scored then. Or a policy that cannot
/// act.
pub fn score(args: &ScoreArgs) -> anyhow::Result<String> {
    if args.precision.is_some_and(|wanted| !wanted.is_available()) {
        warn!("{}", Precision::UNAVAILABLE);
    }
    let subjects =
        args.snapshots.iter().map(|path| Subject::read(path, args)).collect::<anyhow::Result<Vec<Subject>>>()?;
    let tasks: Vec<(&Subject, u32)> = subjects
        .iter()
        .flat_map(|subject| subject.candidates.iter().map(move |&candidates| (subject, candidates)))
        .collect();
    info!("scoring {} policies", subjects.len());
    let scored = tasks.into_par_iter().with_max_len(1).map(|(subject, candidates)| measure(subject, candidates));
    let scored = scored.collect::<anyhow::Result<Vec<Scored>>>()?;
    Ok(if args.json { serde_json::to_string(&scored)? } else { table::table(&scored) })
}

/// Runs a policy's episodes. What one comes to depends on neither the batch it is in nor the number of threads.
fn measure(subject: &Subject, candidates: u32) -> anyhow::Result<Scored> {
    let Subject { path, weights, spec, seed, step, episodes, precision, policy, .. } = subject;
    let batch = |seeds: &[u64]| -> anyhow::Result<Vec<EpisodeOutcome>> {
        let mut rollout = Rollout::new(spec, *seed, seeds, ActionNoise::new)?;
        while !rollout.is_done() {
            rollout
                .step(|observations, noise, actions| policy.act(observations, candidates as usize, noise, actions))
                .with_context(|| format!("{}: the policy cannot act", path.display()))?;
        }
        Ok(rollout.into_outcomes())
    };
    let seeds = episode_seeds(*seed, step.unwrap_or_default(), *episodes);
    let batches = seeds.par_chunks(BATCH).with_max_len(1).map(batch).collect::<anyhow::Result<Vec<_>>>()?;
    let scored = Scored {
        snapshot: path.clone(),
        weights: weights.to_string(),
        environment: spec.name.clone(),
        step: *step,
        seed: *seed,
        candidates,
        precision: precision.arithmetic(),
        episodes: batches.iter().flatten().map(Episode::from).collect(),
    };
    info!("{}, {candidates} candidates: {}", path.display(), table::Spread::of(&scored.scores()));
    Ok(scored)
}

impl Scored {
    fn scores(&self) -> Vec<f64> {
        self.episodes.iter().map(|episode| episode.score).collect()
    }
}

impl From<&EpisodeOutcome> for Episode {
    fn from(outcome: &EpisodeOutcome) -> Self {
        let EpisodeOutcome { seed, episode_return, length, score, .. } = *outcome;
        Self { seed, episode_return, length, score }
    }
}
