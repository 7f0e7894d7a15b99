//! `learner export-data`: the experience of a run as a dataset.

use anyhow::anyhow;
use quad_dataset::{DatasetError, Metadata, OnlineEpisode, write_experience};
use quad_protocol::Episode;
use quad_run::counted;
use quad_run::folder::{RunDir, read_experience};
use quad_runtime::{Hint, print};

use crate::cli::ExportDataArgs;

pub fn export(args: &ExportDataArgs) -> anyhow::Result<()> {
    RunDir::refuse_own_file(&args.out)?;
    let (folder, config) = RunDir::open(&args.run)?;
    let played = read_experience(folder.path())?;
    let Some(last) = played.last() else {
        return Err(anyhow!("{} has no experience", args.run.display())).hint(
            "`learner train --online-steps N` lets evaluators play; the learner keeps their episodes",
        );
    };
    let episodes = Vec::from_iter(played.iter().map(|episode| {
        let Episode { observations, actions, rewards, terminated, interventions, .. } = episode;
        let rows = OnlineEpisode { observations, actions, rewards, terminated: *terminated };
        (rows, interventions.as_slice())
    }));
    let experiment = &config.experiment;
    let metadata = Metadata {
        algorithm: &experiment.algorithm,
        iteration: last.step as i64,
        seed: experiment.seed,
    };
    let (environment, dims) = (&experiment.environment, last.dims());
    write_experience(&args.out, environment, dims, &metadata, &episodes)
        .hint_of(DatasetError::hint)?;
    let rows: usize = episodes.iter().map(|(rows, _)| rows.rewards.len()).sum();
    let (name, episodes) = (args.out.display(), counted(episodes.len(), "episode"));
    print(&format!("{name}: {rows} rows of {episodes} in {environment}"))
}
