//! `evaluator film`: films what a saved policy does.
//!
//! `args`: the arguments; `run_folder`: chooses a snapshot of a run; `episode`: plays it and keeps
//! its poses; `stage`: draws them, with the OpenGL of `gl`; `output`: the file and the layout of
//! its pictures; `encode`: writes `picture`s to the file.
//!
//! A second model with colors draws the pictures after the episode, so the simulation does not
//! depend on them.

mod args;
mod encode;
mod episode;
mod gl;
mod output;
mod picture;
mod run_folder;
mod stage;

use std::path::Path;

use anyhow::{Context, anyhow};
use quad_runtime::Hint;
use tracing::info;

use crate::sim;
use crate::tools::score::{ScoreArgs, Subject};
pub(crate) use args::FilmArgs;
use episode::Episode;
pub(crate) use gl::{Gl, INSTALL};
use output::{Layout, steps, stride};
use stage::Stage;

/// Makes the film. Returns the text to print.
///
/// # Errors
/// A file that is no policy of an environment that this program simulates, no OpenGL, no ffmpeg, or
/// a file that cannot be written.
pub(crate) fn film(args: &FilmArgs) -> anyhow::Result<String> {
    let first = subject(&args.subject, args.step)?;
    let mut subjects = vec![first];
    if let Some(other) = &args.compare {
        subjects.push(subject(other, None)?);
    }
    let (spec, environment_seed) = (subjects[0].spec, subjects[0].seed);
    if let Some(other) = subjects.iter().find(|subject| subject.spec.name != spec.name) {
        let error =
            anyhow!("{} is for {}, not for {}", other.path.display(), other.spec.name, spec.name);
        return Err(error).hint("only policies for one environment can be compared");
    }
    let format = args.out.format;
    let mut stage = Stage::new(spec, Layout::of(format), subjects.len())?;
    let mut episodes: Vec<Episode> = Vec::new();
    for subject in &subjects {
        info!("{}: playing an episode", subject.path.display());
        let seed = args.seed.or(episodes.first().map(|first| first.seed));
        episodes.push(Episode::play(subject, seed, environment_seed)?);
    }
    let control_period = sim::make(spec, environment_seed)?.control_period();
    let last = episodes.iter().map(Episode::length).max().unwrap_or(0);
    let steps = steps(format, last, control_period);
    info!("drawing {} pictures", steps.len());
    let draw =
        |&step| stage.draw(&episodes, step).with_context(|| format!("cannot draw step {step}"));
    let pictures = steps.iter().map(draw);
    encode::write(&args.out, control_period * stride(control_period) as f64, pictures)?;
    Ok(summary(args, &subjects, &episodes))
}

fn subject(path: &Path, step: Option<u64>) -> anyhow::Result<Subject> {
    let snapshot = run_folder::snapshot(path, step)?;
    let mut subjects = Subject::read(&snapshot, &ScoreArgs::default())?;
    Ok(subjects.remove(0))
}

/// A line for each episode, then the file.
fn summary(args: &FilmArgs, subjects: &[Subject], episodes: &[Episode]) -> String {
    let line = |(subject, episode): (&Subject, &Episode)| {
        let (seed, steps) = (episode.seed, episode.length());
        let episode_return = episode.pose(steps).episode_return;
        let (path, choice) = (subject.path.display(), &episode.choice);
        format!("{path}: seed {seed}, {steps} steps, return {episode_return:.2}, {choice}\n")
    };
    let lines: String = subjects.iter().zip(episodes).map(line).collect();
    format!("{lines}film: {}", args.out.path.display())
}
