//! `learner datasets make`: files like D4RL's, by its recipe. SAC learns from nothing; its experience
//! is medium-replay, and its policies record the other files.

use std::path::PathBuf;
use std::process::{Command, Stdio};

use anyhow::{Context, anyhow};
use clap::Parser;
use quad_dataset::{D4rl, DatasetError};
use quad_run::folder::RunDir;
use quad_run::table::Style;
use quad_runtime::{Hint, print};
use tracing::info;

use super::export::write_first_rows;
use super::table;
use crate::children::evaluator_program;
use crate::cli::{Cli, MakeArgs};
use crate::data::made_folder;

/// Environment steps, and gradient steps, of an epoch. As many environment steps come before the
/// first one.
const EPOCH: u64 = 1_000;
/// The last epoch of the expert's training, from 0.
const EXPERT: u64 = 2_999;
/// Rows of a policy's part of a file.
const ROWS: u64 = 1_000_000;

const AGAIN: &str = "the message above says why; the same command goes on from there";

pub fn make(args: &MakeArgs) -> anyhow::Result<()> {
    let making = Making::new(args)?;
    let missing = |kind: &&str| !making.path(kind).exists();
    if making.kinds().iter().any(missing) {
        making.train()?;
    }
    for kind in making.kinds() {
        let path = making.path(kind);
        match (path.exists(), *kind) {
            (true, _) => info!("{} is there", path.display()),
            (false, "medium-replay") => {
                info!("{}", write_first_rows(&making.run, &path, rows_after(making.medium))?);
            }
            (false, _) => making.record(kind)?,
        }
    }
    print(&making.table()?)
}

/// Environment steps of a run up to the end of an epoch, counted from 0.
fn rows_after(epoch: u64) -> u64 {
    EPOCH * (epoch + 2)
}

struct Making<'a> {
    args: &'a MakeArgs,
    d4rl: D4rl,
    folder: PathBuf,
    /// Folder of the run that trains the policies.
    run: PathBuf,
    /// The epochs, from 0, of the medium policy and of the last one.
    medium: u64,
    last: u64,
}

impl<'a> Making<'a> {
    fn new(args: &'a MakeArgs) -> anyhow::Result<Self> {
        let name = &args.env.name;
        let d4rl = args.env.d4rl.with_context(|| format!("D4RL has no such files of {name}"));
        let d4rl = d4rl.hint("choose hopper, walker2d or halfcheetah")?;
        let scaled = |epochs: u64| (epochs as f64 * args.scale).ceil() as u64;
        let medium = args.epoch.unwrap_or(scaled(d4rl.epoch));
        let last = if args.expert { medium.max(scaled(EXPERT)) } else { medium };
        let mut making =
            Self { args, d4rl, folder: made_folder()?, run: PathBuf::new(), medium, last };
        let kind = if args.expert { "sac-expert" } else { "sac" };
        making.run = making.path(kind).with_extension("");
        Ok(making)
    }

    /// The files, in the order in which they are made.
    fn kinds(&self) -> &'static [&'static str] {
        match self.args.expert {
            true => &["random", "medium-replay", "medium", "medium-expert", "expert"],
            false => &["random", "medium-replay", "medium"],
        }
    }

    /// Path of a file, whose name has all that makes it another.
    fn path(&self, kind: &str) -> PathBuf {
        let MakeArgs { env, seed, scale, epoch, .. } = self.args;
        let mut name = format!("{}-{kind}", env.name);
        if *scale != 1.0 {
            name += &format!("-scale{scale}");
        }
        if let Some(epoch) = epoch {
            name += &format!("-epoch{epoch}");
        }
        self.folder.join(format!("{name}-seed{seed}.hdf5"))
    }

    /// Trains, or continues, as the command line would.
    fn train(&self) -> anyhow::Result<()> {
        let MakeArgs { env, seed, evaluators, .. } = self.args;
        let rows = rows_after(self.last);
        let mut line = format!(
            "learner train --env {} --algorithm sac --seed {seed} --online-steps {rows}",
            env.name
        );
        if let Some(count) = evaluators {
            line += &format!(" --evaluators {count}");
        }
        let mut words = Vec::from_iter(line.split(' ').map(Into::into));
        words.extend(["--run-dir".into(), self.run.clone().into_os_string()]);
        super::run(&Cli::try_parse_from(words)?)
    }

    /// Records a file, by its policies in turn.
    fn record(&self, kind: &str) -> anyhow::Result<()> {
        let snapshot = |epoch: u64| RunDir::at(&self.run).snapshot_path(EPOCH * (epoch + 1));
        let policies = match kind {
            "random" => vec!["random".into()],
            "medium" => vec![snapshot(self.medium)],
            "expert" => vec![snapshot(self.last)],
            _ => vec![snapshot(self.medium), snapshot(self.last)],
        };
        let path = self.path(kind);
        let rows = (ROWS as f64 * self.args.scale).ceil() as usize * policies.len();
        let mut command = Command::new(evaluator_program()?);
        command.args(["collect", "--env", &self.args.env.name]).arg("--out").arg(&path);
        command.args(["--transitions", &rows.to_string(), "--seed", &self.args.seed.to_string()]);
        for policy in &policies {
            command.arg("--policy").arg(policy);
        }
        let status = command.stdout(Stdio::null()).status();
        let status = status.context("there is no program `evaluator` beside the learner")?;
        match status.success() {
            true => Ok(()),
            false => Err(anyhow!("{} was not recorded ({status})", path.display())).hint(AGAIN),
        }
    }

    /// Size and scores of the files, and the scores of D4RL's.
    fn table(&self) -> anyhow::Result<String> {
        let header = ["file", "transitions", "episodes", "normalized score", "D4RL's"];
        let mut table = table(header);
        for kind in self.kinds() {
            let path = self.path(kind);
            let inspection = quad_dataset::inspect(&[&path], Some(self.args.env));
            let inspection = inspection.hint_of(DatasetError::hint)?;
            let score = inspection.scores.as_ref().map_or(String::new(), |scores| {
                format!("{:.1} ± {:.1}", scores.mean_score, scores.score_std)
            });
            let theirs = match *kind {
                "medium" => format!("{:.1}", self.d4rl.medium),
                "medium-replay" => format!("{:.1}", self.d4rl.medium_replay),
                "expert" => format!("{:.1}", self.d4rl.expert),
                _ => "-".to_owned(),
            };
            let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let sizes = [inspection.transitions, inspection.episodes];
            let [transitions, episodes] = sizes.map(|size| size.to_string());
            table.push([name, transitions, episodes, score, theirs]);
        }
        let (table, folder) = (table.render(Style::Text), self.folder.display());
        Ok(format!("{table}\nin {folder}; `learner train --dataset NAME` finds them there"))
    }
}
