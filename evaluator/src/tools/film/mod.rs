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
use run_folder::snapshot;
use stage::Stage;

/// Makes the film. Returns the text to print.
pub(crate) fn film(args: &FilmArgs) -> anyhow::Result<String> {
    let mut subjects = vec![subject(&args.subject, args.step)?];
    if let Some(other) = &args.compare {
        subjects.push(subject(other, None)?);
    }
    let (spec, environment_seed) = (subjects[0].spec, subjects[0].seed);
    if let Some(other) = subjects.iter().find(|subject| subject.spec.name != spec.name) {
        let (path, name) = (other.path.display(), &other.spec.name);
        return Err(anyhow!("{path} is for {name}, not for {}", spec.name))
            .hint("only policies for one environment can be compared");
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
    let draw = |&step| {
        let picture = stage.draw(&episodes, step);
        picture.with_context(|| format!("cannot draw step {step}"))
    };
    let seconds = control_period * stride(control_period) as f64;
    encode::write(&args.out, seconds, steps.iter().map(draw))?;
    let mut summary = String::new();
    for (subject, episode) in subjects.iter().zip(&episodes) {
        let (path, steps) = (subject.path.display(), episode.length());
        let Episode { seed, choice, .. } = episode;
        let episode_return = episode.pose(steps).episode_return;
        summary +=
            &format!("{path}: seed {seed}, {steps} steps, return {episode_return:.2}, {choice}\n");
    }
    Ok(format!("{summary}film: {}", args.out.path.display()))
}

/// The policy of a snapshot, or of a run's folder: of `step` there, or the best.
pub(crate) fn subject(path: &Path, step: Option<u64>) -> anyhow::Result<Subject> {
    let snapshot = snapshot(path, step)?;
    let mut subjects = Subject::read(&snapshot, &ScoreArgs::default())?;
    Ok(subjects.remove(0))
}
