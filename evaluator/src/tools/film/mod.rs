//! `evaluator film`: films what a saved policy does.
//!
//! This file: the arguments, and the choice of a run's snapshot; `episode`: plays it and keeps its
//! poses; `stage`: draws them by OpenGL; `encode`: writes the pictures to a file, whose format lays
//! them out.
//!
//! A second model with colors draws the pictures after the episode, so the simulation does not
//! depend on them.

mod encode;
mod episode;
mod stage;

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use clap::Args;
use quad_run::folder::RunDir;
use quad_run::results::RunReport;
use quad_runtime::Hint;
use tracing::info;

use crate::sim;
use crate::tools::score::{ScoreArgs, Subject};
use encode::{Output, output, stride};
use episode::FilmedEpisode;
use stage::Stage;
pub use stage::{Gl, INSTALL};

const RUN: &str =
    "pass a file like RUN/snapshots/step_000020000.safetensors, or the folder of a run";

const AFTER_HELP: &str = "\
Examples:
  # The first episode of a run's best evaluation, as an animation that any browser shows.
  evaluator film runs/mine --out film.gif

  # The same with an early snapshot beside it, from the same start, as eight pictures in a row.
  evaluator film runs/mine --compare runs/mine/snapshots/step_000002000.safetensors --out film.png

A film needs no GPU and no screen, but Mesa's software driver: apt-get install --no-install-recommends libegl1 libegl-mesa0 \
libgl1-mesa-dri";

/// Film an episode of a saved policy: an animation, a video or a strip of pictures
///
/// The episode is one on which the run evaluates the snapshot, so its return equals the one in the
/// run (with the same arithmetic).
#[derive(Args, Debug)]
#[command(after_help = AFTER_HELP)]
pub struct FilmArgs {
    /// A snapshot, or the folder of a run: then the snapshot with the best complete evaluation, or
    /// the newest if there is none
    #[arg(value_name = "SNAPSHOT|RUN")]
    subject: PathBuf,
    /// The snapshot of this gradient step, if a run's folder is given
    #[arg(long, value_name = "N")]
    step: Option<u64>,
    /// Another snapshot or run to show beside the first, in an episode of the same seed
    #[arg(long, value_name = "SNAPSHOT|RUN")]
    compare: Option<PathBuf>,
    /// Seed of the episode, as in scores.jsonl and `evaluator score --json` [default: the first on
    /// which the run evaluates the snapshot]
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// File to write: .gif (320 × 240), .mp4 (480 × 360, by ffmpeg) or .png (eight pictures in a
    /// row)
    #[arg(long, value_name = "FILE", default_value = "film.gif", value_parser = output)]
    out: Output,
}

/// Makes the film. Returns the text to print.
pub fn film(args: &FilmArgs) -> anyhow::Result<String> {
    let read = |path: &Path, step| {
        let mut subjects = Subject::read(&snapshot(path, step)?, &ScoreArgs::default())?;
        anyhow::Ok(subjects.remove(0))
    };
    let mut subjects = vec![read(&args.subject, args.step)?];
    if let Some(path) = &args.compare {
        subjects.push(read(path, None)?);
    }
    let (spec, environment_seed) = (subjects[0].spec, subjects[0].seed);
    if let Some(unlike) = subjects.iter().find(|subject| subject.spec.name != spec.name) {
        let (path, name) = (unlike.path.display(), &unlike.spec.name);
        return Err(anyhow!("{path} is for {name}, not for {}", spec.name))
            .hint("only policies for one environment can be compared");
    }
    let mut stage = Stage::new(spec, args.out.format, subjects.len())?;
    let mut episodes: Vec<FilmedEpisode> = Vec::new();
    for subject in &subjects {
        info!("{}: playing an episode", subject.path.display());
        let seed = args.seed.or(episodes.first().map(|first| first.seed));
        episodes.push(FilmedEpisode::play(subject, seed, environment_seed)?);
    }
    let control_period = sim::make(spec, environment_seed)?.control_period();
    let last = episodes.iter().map(FilmedEpisode::length).max().unwrap_or(0);
    let steps = args.out.format.steps(last, control_period);
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
        let FilmedEpisode { seed, choice, .. } = episode;
        let episode_return = episode.pose(steps).episode_return;
        summary +=
            &format!("{path}: seed {seed}, {steps} steps, return {episode_return:.2}, {choice}\n");
    }
    Ok(format!("{summary}film: {}", args.out.path.display()))
}

/// The snapshot that `path` names. In a run's folder it is the snapshot of `step` or, without a
/// step, the one with the best complete evaluation of those that are left, else the newest.
fn snapshot(path: &Path, step: Option<u64>) -> anyhow::Result<PathBuf> {
    let name = path.display();
    if !path.is_dir() {
        return match step {
            None if path.exists() => Ok(path.to_owned()),
            None => Err(anyhow!("there is no {name}")).hint(RUN),
            Some(_) => Err(anyhow!("{name} is not the folder of a run"))
                .hint("--step needs the folder of a run"),
        };
    }
    let run = RunDir::at(path);
    let steps = run.snapshots().hint(RUN)?;
    let step = match step {
        Some(step) => step,
        None => {
            let report = RunReport::scored(path).hint(RUN)?;
            let best = report.best_of(|step| steps.contains(&step));
            let step = best.map(|best| best.step).or(steps.last().copied());
            step.with_context(|| format!("{name} has no snapshot")).hint(RUN)?
        }
    };
    if !steps.contains(&step) {
        return Err(anyhow!("{name} has no snapshot of step {step}"))
            .hint(format!("its snapshots have the steps {steps:?}"));
    }
    Ok(run.snapshot_path(step))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use quad_run::config::{RunConfig, resolve};
    use serde_json::json;

    use super::*;

    /// Of a run that is evaluated every 10 steps, in two episodes each.
    fn make_run(folder: &Path) {
        let mut experiment = resolve("hopper-demo", &Default::default()).unwrap();
        (experiment.steps, experiment.eval_interval, experiment.episodes) = (50, 10, 2);
        let config = json!({
            "run": { "name": "r", "incarnation": 1, "task": "hopper-demo", "version": "0.1.0" },
            "dataset": { "path": "d", "transitions": 1, "episodes": 1, "min_return": 0.0, "mean_return": 0.0, "max_return": 0.0 },
            "experiment": experiment,
        });
        let config: RunConfig = serde_json::from_value(config).unwrap();
        RunDir::create(folder, &config).unwrap();
    }

    #[test]
    fn chooses_the_best_snapshot_the_newest_or_the_one_of_a_step() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path();
        make_run(run);
        let file = |step: u64| run.join(format!("snapshots/step_{step:09}.safetensors"));
        let set_scores = |scores: &[(u64, u64, f64)], rest: &str| {
            let line = |&(step, seed, score): &(u64, u64, f64)| {
                let line = json!({ "step": step, "seed": seed, "return": 1.0, "length": 5, "score": score, "weights": "00", "evaluator": "e" });
                format!("{line}\n")
            };
            let lines: String = scores.iter().map(line).collect();
            fs::write(run.join("scores.jsonl"), lines + rest).unwrap();
        };
        for step in [10, 20, 30] {
            fs::write(file(step), "").unwrap();
        }
        set_scores(&[(10, 1, 99.0)], "");
        // No evaluation is complete.
        assert_eq!(snapshot(run, None).unwrap(), file(30));
        let [ten, twenty] = [[(10, 1, 5.0), (10, 2, 7.0)], [(20, 3, 9.0), (20, 4, 1.0)]];
        let scores = [&ten[..], &twenty, &[(30, 5, 99.0)]].concat();
        set_scores(&scores, "{\"step\":30,\"seed\":6,\"re");
        // That of step 30 is incomplete.
        assert_eq!(snapshot(run, None).unwrap(), file(10));
        assert_eq!(snapshot(run, Some(20)).unwrap(), file(20));
        assert_eq!(snapshot(&file(20), None).unwrap(), file(20));
        assert!(snapshot(&file(20), Some(20)).is_err());
        fs::remove_file(file(10)).unwrap();
        assert_eq!(snapshot(run, None).unwrap(), file(20));
    }
}
