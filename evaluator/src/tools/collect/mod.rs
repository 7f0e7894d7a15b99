//! Records a dataset of mediocre behavior, so that a new machine needs no download.
//!
//! Following the recipe in an environment's row, `search` trains `linear` policies, and `record`
//! mixes episodes of all of them, from the first to the last, into one file in D4RL's layout. The
//! result resembles D4RL's "medium-replay", the replay buffer of a learning policy. The file is a
//! function of the number of transitions and the seed; the number of threads does not change it.

mod linear;
mod record;
mod search;

use std::path::Path;
use std::time::Instant;

use anyhow::anyhow;
use quad_dataset::environment::{all, find};
use quad_dataset::{Collect, D4rlWriter, EnvironmentSpec, Metadata, Recipe};
use quad_runtime::Hint;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const OUT: &str = "--out names a file in a folder that you may write in";
const MUJOCO: &str =
    "deploy/setup.sh installs the version of MuJoCo that this program was built for";

/// The streams of the file's seed: one for recording, the next ones for the searches.
const RECORD_STREAM: u64 = 0;

/// What was recorded.
#[derive(Debug)]
pub struct Summary {
    /// Rows in the file.
    pub transitions: usize,
    /// Episodes in the file.
    pub episodes: usize,
    /// Mean over the episodes of D4RL's normalized score.
    pub mean_score: f64,
    /// The 50th, 90th and 99th percentile, and the maximum, of the normalized scores.
    pub score_percentiles: [f64; 4],
    /// Policies that act in the episodes.
    pub policies: usize,
    /// Wall-clock time of the command.
    pub seconds: f64,
}

/// The environment of that name, if this command can record in it.
///
/// # Errors
/// It cannot; the text lists the possible environments.
pub fn environment(name: &str) -> Result<&'static EnvironmentSpec, String> {
    let found = find(name).map_err(|_| format!("there is no environment `{name}`"));
    let found =
        found.and_then(|spec| recipe(spec).map(|_| spec).map_err(|error| error.to_string()));
    let possible = all().iter().filter(|spec| recipe(spec).is_ok()).map(|spec| spec.name.as_str());
    found.map_err(|error| {
        format!("{error}; what can be recorded is {}", possible.collect::<Vec<_>>().join(", "))
    })
}

fn recipe(spec: &'static EnvironmentSpec) -> anyhow::Result<&'static Recipe> {
    match &spec.collect {
        Collect::Recipe(recipe) => Ok(recipe),
        Collect::None(reason) => Err(anyhow!("nothing can be recorded in {}: {reason}", spec.name)),
    }
}

/// Trains, then records at least `transitions` transitions, in whole episodes, to `path`.
///
/// # Errors
/// The environment has no recipe, MuJoCo fails, or the file cannot be written.
pub fn collect(
    spec: &'static EnvironmentSpec,
    path: &Path,
    transitions: usize,
    seed: u64,
) -> anyhow::Result<Summary> {
    let start = Instant::now();
    let recipe = recipe(spec)?;
    let mut writer = D4rlWriter::create(path, spec).hint(OUT)?;

    let random = |index| stream(seed, RECORD_STREAM + 1 + index);
    let policies = search::train(spec, recipe, transitions, random).hint(MUJOCO)?;
    let mut scores = record::record(
        spec,
        recipe,
        &policies,
        transitions,
        stream(seed, RECORD_STREAM),
        &mut writer,
    )?;
    let rows = writer.rows();
    let (algorithm, iteration) =
        ("augmented random search, all iterations, with action noise", policies.len() as i64 - 1);
    writer.finish(&Metadata { algorithm, iteration, seed }).hint(OUT)?;

    scores.sort_by(f64::total_cmp);
    let percentile = |percent: usize| scores[(scores.len() - 1) * percent / 100];
    Ok(Summary {
        transitions: rows,
        episodes: scores.len(),
        mean_score: scores.iter().sum::<f64>() / scores.len() as f64,
        score_percentiles: [50, 90, 99, 100].map(percentile),
        policies: policies.len(),
        seconds: start.elapsed().as_secs_f64(),
    })
}

fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    random
}
