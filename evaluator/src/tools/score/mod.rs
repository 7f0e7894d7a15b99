//! `evaluator score`: scores saved policies, on this machine alone.
//!
//! This file: the way from the arguments (`args`) to the results; `subject`: a policy, and its
//! episodes; `results`: their table.

mod args;
mod results;
mod subject;

use quad_policy::Precision;
use quad_protocol::episode_seeds;
use quad_run::results::Spread;
use rayon::prelude::*;
use tracing::{info, warn};

pub use args::ScoreArgs;
pub use results::title;
use results::{Scored, table};
pub use subject::Subject;
use subject::once_each;

/// Episodes per batch. The limit bounds memory; a larger batch is hardly faster.
const BATCH: usize = 16;

/// Scores the policies of the command line. Returns the text to print.
pub fn score(args: &ScoreArgs) -> anyhow::Result<String> {
    if !args.precision.is_available() {
        warn!("{}", Precision::UNAVAILABLE);
    }
    let read = once_each(&args.snapshots).map(|path| Subject::read(path, args));
    let subjects = read.collect::<anyhow::Result<Vec<_>>>()?;
    info!("policies to score: {}", subjects.len());
    let subjects: Vec<Subject> = subjects.into_iter().flatten().collect();
    let scored = subjects.par_iter().with_max_len(1).map(measure);
    let scored = scored.collect::<anyhow::Result<Vec<Scored>>>()?;
    Ok(if args.json { quad_runtime::json(&scored)? } else { table(&scored) })
}

/// Runs a policy's episodes. An episode's result depends on neither its batch nor the number of
/// threads.
fn measure(subject: &Subject) -> anyhow::Result<Scored> {
    let seeds = episode_seeds(subject.seed, subject.step, subject.episodes);
    let batches = seeds.par_chunks(BATCH).with_max_len(1);
    let batches = batches.map(|seeds| subject.roll_out(seeds));
    let scored = Scored {
        snapshot: subject.path.display().to_string(),
        weights: subject.weights.to_string(),
        environment: subject.spec.name.clone(),
        step: subject.step,
        seed: subject.seed,
        choice: subject.policy.choice(),
        precision: subject.policy.precision().arithmetic(),
        episodes: batches.collect::<anyhow::Result<Vec<_>>>()?.concat(),
    };
    let spread = scored.spread().map(Spread::text).unwrap_or_default();
    info!("{}, {}: {spread}", subject.path.display(), scored.title());
    Ok(scored)
}
