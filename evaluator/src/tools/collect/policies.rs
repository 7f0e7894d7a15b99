//! Records whole episodes of trained policies, or of uniform random actions.

use std::path::Path;

use anyhow::Context;
use quad_dataset::D4rlWriter;
use quad_policy::EpisodeState;
use quad_run::folder::RunDir;
use quad_runtime::{Hint, ProgressBar};
use rand::Rng;
use rayon::prelude::*;

use super::recorder::Recorder;
use super::{CollectArgs, MUJOCO, OUT, RECORD_STREAM, Recorded, stream};
use crate::serve::exploration::{add_noise, draw_uniform};
use crate::sim::Rollout;
use crate::tools::score::{ScoreArgs, Subject};

/// The name of uniform random actions in place of a policy's file.
const RANDOM: &str = "random";

/// Episodes per batch: enough that a policy's call costs little beside the physics.
const BATCH: usize = 16;
/// Most episodes that run at once, in batches that share the threads.
const ROUND: usize = 128;

/// Records equal shares of the transitions by each behavior, one after the other.
pub fn record(
    behaviors: &[Behavior],
    args: &CollectArgs,
    writer: &mut D4rlWriter,
) -> anyhow::Result<Recorded> {
    let (wanted, count) = (args.transitions as usize, behaviors.len());
    let progress = ProgressBar::new("transitions recorded");
    progress.start(0, wanted as u64);
    let mut random = stream(args.seed, RECORD_STREAM);
    let mut scores = Vec::new();
    for (i, behavior) in behaviors.iter().enumerate() {
        let end = wanted * (i + 1) / count;
        while writer.rows() < end {
            let least = (end - writer.rows()).div_ceil(args.env.max_episode_steps);
            let round = least.clamp(BATCH, ROUND);
            let seeds = Vec::from_iter((0..round).map(|_| random.random()));
            let batches = seeds.par_chunks(BATCH).with_max_len(1);
            let played = batches.map(|seeds| behavior.play(args, seeds));
            for episode in played.collect::<anyhow::Result<Vec<_>>>()?.iter().flatten() {
                if writer.rows() < end {
                    episode.write(writer).hint(OUT)?;
                    scores.push(args.env.normalized_score(episode.episode_return));
                }
            }
            progress.advance(writer.rows() as u64);
        }
    }
    let join = |text: fn(&Behavior) -> Option<String>| {
        let texts = Vec::from_iter(behaviors.iter().filter_map(text));
        (!texts.is_empty()).then(|| texts.join("; "))
    };
    let last = behaviors.iter().rev().find_map(|behavior| behavior.subject.as_ref());
    Ok(Recorded {
        scores,
        policies: count,
        algorithm: join(|behavior| Some(behavior.algorithm.clone())).unwrap_or_default(),
        iteration: last.map_or(0, |subject| subject.step as i64),
        run: join(|behavior| behavior.run.clone()),
        weights: join(|behavior| Some(behavior.subject.as_ref()?.weights.to_string())),
    })
}

/// What acts.
pub struct Behavior {
    /// `None` for uniform random actions.
    subject: Option<Subject>,
    /// Algorithm and way to act.
    algorithm: String,
    run: Option<String>,
}

impl Behavior {
    pub fn read(path: &Path, args: &CollectArgs) -> anyhow::Result<Self> {
        if path == Path::new(RANDOM) {
            return Ok(Self { subject: None, algorithm: "uniform".to_owned(), run: None });
        }
        let options = ScoreArgs { env: Some(args.env), ..ScoreArgs::default() };
        let subject = Subject::read(path, &options)?.remove(0);
        let folder = path.ancestors().nth(2).map(RunDir::at);
        let config = folder.and_then(|folder| folder.read_config().ok());
        let own = config.map(|run| [run.run.name.to_string(), run.experiment.algorithm]);
        let (run, algorithm) = match subject.origin.clone().or(own) {
            Some([run, algorithm]) => (Some(run), algorithm),
            None => (None, "unknown algorithm".to_owned()),
        };
        let way = if args.mode { "mode" } else { "sampled" };
        let algorithm = format!("{algorithm}, {way}, noise {}", args.noise);
        Ok(Self { subject: Some(subject), algorithm, run })
    }

    /// Plays the episodes of some seeds as one batch.
    fn play(&self, args: &CollectArgs, seeds: &[u64]) -> anyhow::Result<Vec<Recorder>> {
        let make = || Ok(Box::new(Recorder::new(args.env)?));
        let begin = |seed| match &self.subject {
            Some(subject) => subject.policy.begin(seed),
            None => EpisodeState::new(seed),
        };
        let mut rollout = Rollout::new(make, args.env.sizes(), seeds, begin).hint(MUJOCO)?;
        while !rollout.is_done() {
            rollout.step(|observations, states, actions| {
                let Some(subject) = &self.subject else {
                    draw_uniform(states, actions);
                    return Ok(());
                };
                let policy = &*subject.policy;
                let acted = match args.mode {
                    true => policy.act(observations, states, actions),
                    false => policy.explore(observations, states, actions),
                };
                let mut change = |actions: &mut [f32]| add_noise(args.noise, states, actions);
                if args.noise > 0.0 {
                    policy.change_actions(actions, &mut change);
                }
                acted.with_context(|| subject.cannot_act())
            })?;
        }
        Ok(rollout.into_environments())
    }
}
