//! Records a dataset of mediocre behavior, so that a new machine needs no download.
//!
//! Following the recipe in an environment's row, `search` trains linear policies, and `record`
//! mixes episodes of all of them, from the first to the last, into one file in D4RL's layout. The
//! result resembles D4RL's "medium-replay", the replay buffer of a learning policy. The file is a
//! function of the number of transitions and the seed; the number of threads does not change it.

mod record;
mod search;
#[cfg(test)]
mod tests;

use std::fmt;
use std::path::Path;
use std::time::Instant;

use anyhow::Context;
use quad_dataset::environment::{all, find};
use quad_dataset::{D4rlWriter, EnvironmentSpec, Metadata};
use quad_run::counted;
use quad_runtime::Hint;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const OUT: &str = "choose a file with --out in a folder that you may write to";
const NO_RECIPE: &str = "linear policies cannot solve a maze";
const MUJOCO: &str =
    "deploy/setup.sh installs the version of MuJoCo that this program was built for";

/// Stream of the file's seed for the recording. The next ones are for the searches.
const RECORD_STREAM: u64 = 0;

#[derive(Debug)]
pub struct Summary {
    pub transitions: usize,
    pub episodes: usize,
    /// Mean of D4RL's normalized score over the episodes.
    pub mean_score: f64,
    /// The 50th, 90th and 99th percentile, and the maximum, of the normalized scores.
    pub score_percentiles: [f64; 4],
    pub policies: usize,
    /// Wall-clock time of the command.
    pub seconds: f64,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p90, p99, max] = self.score_percentiles;
        let (transitions, mean) = (self.transitions, self.mean_score);
        let episodes = counted(self.episodes, "episode");
        write!(f, "{transitions} transitions, {episodes} of {} ", self.policies)?;
        writeln!(f, "policies, in {:.0} s", self.seconds)?;
        write!(f, "normalized score: mean {mean:.1}, median {p50:.1}, ")?;
        write!(f, "p90 {p90:.1}, p99 {p99:.1}, max {max:.1}")
    }
}

/// Finds an environment in which this command can record; an error lists them.
pub fn environment(name: &str) -> Result<&'static EnvironmentSpec, String> {
    let problem = match find(name) {
        Err(_) => format!("there is no environment `{name}`"),
        Ok(spec) if spec.collect.is_some() => return Ok(spec),
        Ok(_) => format!("no dataset can be recorded in {name}: {NO_RECIPE}"),
    };
    let possible = all().iter().filter(|spec| spec.collect.is_some());
    let names = Vec::from_iter(possible.map(|spec| spec.name.as_str()));
    Err(format!("{problem}; datasets can be recorded in {}", names.join(", ")))
}

/// Trains, then records at least `transitions` transitions, in whole episodes, to `path`.
pub fn collect(
    spec: &'static EnvironmentSpec,
    path: &Path,
    transitions: usize,
    seed: u64,
) -> anyhow::Result<Summary> {
    let start = Instant::now();
    let recipe = spec.collect.as_ref().context(NO_RECIPE)?;
    let mut writer = D4rlWriter::create(path, spec).hint(OUT)?;

    let random = |index| stream(seed, RECORD_STREAM + 1 + index);
    let policies = search::train(spec, recipe, transitions, random).hint(MUJOCO)?;
    let random = stream(seed, RECORD_STREAM);
    let mut scores = record::record(spec, recipe, &policies, transitions, random, &mut writer)?;
    let rows = writer.rows();
    let algorithm = "augmented random search, all iterations, with action noise";
    let iteration = policies.len() as i64 - 1;
    let metadata = Metadata { algorithm, iteration, seed };
    writer.finish(&metadata).hint(OUT)?;

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
