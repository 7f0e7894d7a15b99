//! Records a dataset, so that a new machine needs no download.
//!
//! Given policies, `policies` records whole episodes of each. Without any, `search` trains linear
//! ones by the recipe in an environment's row, and `record` mixes episodes of all of them, from the
//! first to the last; the result resembles D4RL's "medium-replay", the replay buffer of a learning
//! policy. The file is in D4RL's layout. It is a function of the arguments; the number of threads
//! does not change it.

mod policies;
mod record;
mod recorder;
mod search;
#[cfg(test)]
mod tests;

use std::fmt;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, anyhow};
use clap::{Args, value_parser};
use quad_dataset::environment::{find, specs};
use quad_dataset::{D4rlWriter, EnvironmentSpec, Metadata, Recipe, Simulator};
use quad_run::counted;
use quad_run::folder::{RunDir, RunDirError};
use quad_run::results::Spread;
use quad_runtime::Hint;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const OUT: &str = "choose a file with --out in a folder that you may write to";
const MAZE: &str = "files of mazes need goals, which this command does not write";
const MUJOCO: &str =
    "deploy/setup.sh installs the version of MuJoCo that this program was built for";

/// Stream of the file's seed for the recording. The next ones are for the searches.
const RECORD_STREAM: u64 = 0;

const AFTER_HELP: &str = "\
Examples:
  # A mixed dataset of linear policies, which this command trains first; one to two minutes on two cores.
  evaluator collect --env hopper --out hopper-demo.hdf5

  # A million transitions of a run's policy, drawn from its distribution, as in D4RL's medium and expert files.
  evaluator collect --env hopper --policy runs/mine/snapshots/step_000400000.safetensors --transitions 1000000 --out medium.hdf5

  # Half of them by uniform random actions.
  evaluator collect --env hopper --policy random --policy policy.safetensors --out half.hdf5

RAYON_NUM_THREADS sets the number of processor cores; the default is all. It does not change the file.";

/// Record a dataset: of policies that you have, or of mediocre ones that this command trains
///
/// Writes one file in D4RL's layout (HDF5), in whole episodes. Without --policy it trains linear
/// policies by augmented random search, from policies that fall at once to policies that move well,
/// and mixes noisy episodes of all of them. The same seed makes the same data.
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct CollectArgs {
    /// Environment to act in, such as hopper
    #[arg(long, value_name = "NAME", value_parser = environment)]
    pub env: &'static EnvironmentSpec,
    /// Policy that acts: a snapshot of a run, an exported policy, or the word random for uniform
    /// random actions; several have equal shares of the transitions, one after the other
    #[arg(long, value_name = "FILE")]
    pub policy: Vec<PathBuf>,
    /// Take the policy's most likely action instead of drawing one from its distribution
    #[arg(long, requires = "policy")]
    pub mode: bool,
    /// Standard deviation of normal noise on the policy's actions, which span ±1
    #[arg(long, value_name = "STD", default_value = "0", value_parser = noise, requires = "policy")]
    pub noise: f32,
    /// File to write; it appears when it is complete
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Least number of transitions; the last episode is recorded to its end
    #[arg(long, value_name = "N", default_value = "100000", value_parser = value_parser!(u32).range(1..))]
    pub transitions: u32,
    /// Seed of all random numbers
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

fn noise(text: &str) -> Result<f32, &'static str> {
    let std = text.parse().ok().filter(|std| (0.0..=1.0).contains(std));
    std.ok_or("not a number from 0 to 1")
}

#[derive(Debug)]
pub struct Summary {
    pub transitions: usize,
    pub episodes: usize,
    /// D4RL's normalized score over the episodes.
    pub score: Spread,
    /// The 50th, 90th and 99th percentile, and the maximum, of the normalized scores.
    pub score_percentiles: [f64; 4],
    pub policies: usize,
    /// Wall-clock time of the command.
    pub seconds: f64,
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [p50, p90, p99, max] = self.score_percentiles;
        let (transitions, score) = (self.transitions, self.score);
        let episodes = counted(self.episodes, "episode");
        let policies = self.policies;
        let noun = if policies == 1 { "policy" } else { "policies" };
        let seconds = self.seconds;
        writeln!(
            f,
            "{transitions} transitions, {episodes} of {policies} {noun}, in {seconds:.0} s"
        )?;
        let std = score.std.unwrap_or_default();
        write!(f, "normalized score: mean {:.1} ± {std:.1}, median {p50:.1}, ", score.mean)?;
        write!(f, "p90 {p90:.1}, p99 {p99:.1}, max {max:.1}")
    }
}

/// Finds an environment in which this command can record; an error lists them.
pub fn environment(name: &str) -> Result<&'static EnvironmentSpec, String> {
    let is_plane = |spec: &EnvironmentSpec| matches!(spec.simulator, Simulator::Planar(_));
    let problem = match find(name) {
        Err(_) => format!("there is no environment `{name}`"),
        Ok(spec) if is_plane(spec) => return Ok(spec),
        Ok(_) => format!("no dataset can be recorded in {name}: {MAZE}"),
    };
    let possible = specs().iter().filter(|spec| is_plane(spec));
    let names = Vec::from_iter(possible.map(|spec| spec.name.as_str()));
    Err(format!("{problem}; datasets can be recorded in {}", names.join(", ")))
}

/// The episodes of a file and what acted, as its metadata have it.
struct Recorded {
    /// Normalized scores of the episodes.
    scores: Vec<f64>,
    policies: usize,
    algorithm: String,
    iteration: i64,
    run: Option<String>,
    weights: Option<String>,
}

/// Records at least `args.transitions` transitions, in whole episodes.
pub fn collect(args: &CollectArgs) -> anyhow::Result<Summary> {
    let start = Instant::now();
    RunDir::refuse_own_file(&args.out).hint_of(RunDirError::hint)?;
    let behaviors = args.policy.iter().map(|path| policies::Behavior::read(path, args));
    let behaviors = behaviors.collect::<anyhow::Result<Vec<_>>>()?;
    let recipe = args.env.collect.as_ref().filter(|_| behaviors.is_empty());
    if behaviors.is_empty() && recipe.is_none() {
        return Err(anyhow!("no recipe for linear policies in {}", args.env.name))
            .hint("name a policy by --policy FILE, or --policy random");
    }
    let mut writer = D4rlWriter::create(&args.out, args.env).hint(OUT)?;
    let recorded = match recipe {
        Some(recipe) => search(recipe, args, &mut writer)?,
        None => policies::record(&behaviors, args, &mut writer)?,
    };
    let rows = writer.rows();
    let Recorded { mut scores, policies, algorithm, iteration, run, weights } = recorded;
    let (seed, run, weights) = (args.seed, run.as_deref(), weights.as_deref());
    let metadata = Metadata { algorithm: &algorithm, iteration, seed, run, weights };
    writer.finish(&metadata).hint(OUT)?;

    scores.sort_by(f64::total_cmp);
    let percentile = |percent: usize| scores[(scores.len() - 1) * percent / 100];
    Ok(Summary {
        transitions: rows,
        episodes: scores.len(),
        score: Spread::new(&scores).context("no episode was recorded")?,
        score_percentiles: [50, 90, 99, 100].map(percentile),
        policies,
        seconds: start.elapsed().as_secs_f64(),
    })
}

/// Trains linear policies by the environment's recipe, and records a mixture of them.
fn search(
    recipe: &Recipe,
    args: &CollectArgs,
    writer: &mut D4rlWriter,
) -> anyhow::Result<Recorded> {
    let (spec, transitions) = (args.env, args.transitions as usize);
    let random = |index| stream(args.seed, RECORD_STREAM + 1 + index);
    let policies = search::train(spec, recipe, transitions, random).hint(MUJOCO)?;
    let random = stream(args.seed, RECORD_STREAM);
    Ok(Recorded {
        scores: record::record(spec, recipe, &policies, transitions, random, writer)?,
        policies: policies.len(),
        algorithm: "augmented random search, all iterations, with action noise".to_owned(),
        iteration: policies.len() as i64 - 1,
        run: None,
        weights: None,
    })
}

fn stream(seed: u64, stream: u64) -> ChaCha8Rng {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(stream);
    random
}
