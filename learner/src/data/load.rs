//! The transitions of a run.

use std::path::PathBuf;

use anyhow::{Context, anyhow};
use quad_dataset::{
    DatasetError, EnvironmentSpec, HoldOut, Normalize, Problem, ReadOptions, Split, Transitions,
    benchmarks, environment,
};
use quad_run::config::Experiment;
use quad_runtime::Hint;
use toml::Value;

/// Reads the transitions of files or folders for an experiment, none without a file. A run that has
/// begun has `held_out` episodes. Fewer transitions than a batch are an error: a batch never holds
/// one twice while there are others.
pub fn load(
    paths: &[PathBuf],
    experiment: &Experiment,
    held_out: Option<&[usize]>,
) -> anyhow::Result<Split> {
    if paths.is_empty() {
        let training = without_data(experiment)?;
        return Ok(Split { training, held_out: None, episodes: Vec::new(), files: Vec::new() });
    }
    let chunk = experiment.agent.get("chunk").and_then(Value::as_integer).unwrap_or(1);
    let options = ReadOptions {
        environment: environment::find(&experiment.environment).ok(),
        task: benchmarks::relabeling(&experiment.environment),
        reward: experiment.reward,
        normalize: experiment.normalize,
        chunk: chunk as usize,
    };
    let hold_out = held_out.map_or(HoldOut::Fraction(experiment.hold_out), HoldOut::Episodes);
    let result = Transitions::read_split(paths, &options, hold_out).hint_of(DatasetError::hint);
    let names = Vec::from_iter(paths.iter().map(|path| path.to_string_lossy())).join(", ");
    let split = result.with_context(|| format!("cannot learn from {names}"))?;
    let (there, batch) = (split.training.len(), experiment.batch_size);
    if there < batch as usize {
        let error = anyhow!("{there} transitions are fewer than a batch of {batch}");
        return Err(error).hint("record more data, or ask for less with --set batch_size=N");
    }
    Ok(split)
}

fn without_data(experiment: &Experiment) -> anyhow::Result<Transitions> {
    let name = &experiment.environment;
    for (key, is_absent) in [
        ("steps", experiment.steps == 0),
        ("normalize", experiment.normalize == Normalize::default()),
    ] {
        if !is_absent {
            return Err(anyhow!("{key} is about a dataset, and there is none"))
                .hint(format!("name one by --dataset, or leave out {key}"));
        }
    }
    let sizes = environment::find(name).map(EnvironmentSpec::sizes).ok();
    let sizes = sizes.or(experiment.sizes.map(Into::into));
    let sizes = sizes.with_context(|| format!("the sizes of {name} are not known")).hint(
        "--set sizes=[11,3] says that an observation has 11 numbers, an action 3; or name a dataset by --dataset",
    )?;
    Transitions::without_data(sizes, experiment.reward).hint_of(Problem::hint)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use quad_dataset::{Arrays, Names, write_own};
    use quad_run::config::Preset;
    use tempfile::tempdir;

    use super::*;

    /// Twenty episodes of ten steps.
    fn arrays() -> Arrays {
        let rows = 200;
        let wave = |row: usize| (row as f32).sin();
        Arrays {
            observation_dim: 1,
            action_dim: 1,
            observations: (0..rows).map(wave).collect(),
            actions: (0..rows).map(|row| 0.9 * wave(2 * row)).collect(),
            rewards: (0..rows).map(wave).collect(),
            next_observations: (1..=rows).map(wave).collect(),
            terminals: vec![false; rows],
            timeouts: (1..=rows).map(|row| row % 10 == 0).collect(),
        }
    }

    #[test]
    fn all_seeds_hold_out_the_same_episodes_and_a_run_that_has_begun_its_own() {
        let folder = tempdir().unwrap();
        let path = folder.path().join("own.hdf5");
        write_own(&path, arrays(), Names::default()).unwrap();
        let preset = Preset::read("own-data").unwrap();
        let held_out = |seed: u64, begun| {
            let changes = format!(
                "algorithm = 'qc'\nenvironment = 'robot'\nbatch_size = 8\nhold_out = 0.2\nseed = {seed}\nagent.chunk = 11"
            );
            let experiment = preset.resolve(&changes.parse().unwrap()).unwrap();
            let split = load(std::slice::from_ref(&path), &experiment, begun).unwrap();
            let warnings = split.training.warnings();
            assert!(warnings.len() == 1 && warnings[0].contains("the longest 10"), "{warnings:?}");
            split.episodes
        };
        let episodes = held_out(1, None);
        assert_eq!((episodes.len(), &held_out(2, None)), (4, &episodes));
        assert_eq!(held_out(2, Some(&[3, 5])), [3, 5], "as an older version chose them");
    }
}
