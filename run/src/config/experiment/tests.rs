//! Tests of experiments.

use crate::config::{RunConfig, resolve, settings};
use quad_runtime::one_line;
use toml::Table;

/// With target networks, values approach their fixed point as 1 − exp(−rate·(1 − γ)·steps) where
/// episodes are long.
#[test]
fn critics_converge_within_a_demonstration() {
    for algorithm in quad_algorithms::ALGORITHMS {
        if ["dtql", "sfbc", "diffuser", "diffusion-policy"].contains(&algorithm.name) {
            continue;
        }
        let changes = Table::from_iter([("algorithm".to_owned(), algorithm.name.into())]);
        let demonstration = resolve("hopper-demo", &changes).unwrap();
        let value = |key| demonstration.agent[key].as_float().unwrap();
        let steps = demonstration.total_steps() as f64;
        let progress = value("ema_rate") * (1.0 - value("gamma")) * steps;
        assert!(progress > 3.0, "{}: {progress}", algorithm.name);
    }
}

#[test]
fn gradient_steps_wait_for_each_environment_step_that_they_have_begun() {
    let online = "steps = 10
online = { steps = 9, warmup = 4, updates_per_step = 3 }";
    let experiment = resolve("own-data", &format!("algorithm = 'iql'\n{online}").parse().unwrap());
    let experiment = experiment.unwrap();
    let rows = [0, 10, 11, 13, 14, 25].map(|step| experiment.environment_steps(step));
    assert_eq!(rows, [0, 0, 5, 5, 6, 9].map(Some));
    assert_eq!(experiment.total_steps(), 25);
}

#[test]
fn older_runs_learned_from_one_file_whose_hash_counts() {
    let config = crate::fixtures::config("run", 0);
    let mut table = Table::try_from(&config).unwrap();
    let data = table["dataset"].as_table_mut().unwrap();
    let file = data.remove("files").unwrap()[0].as_table().unwrap().clone();
    data.extend(file.into_iter().filter(|(key, _)| ["path", "sha256"].contains(&&**key)));
    let older: RunConfig = table.try_into().unwrap();
    assert_eq!(older, config);
    let mut moved = config.clone();
    moved.dataset.files[0].path = "moved.hdf5".into();
    assert_eq!(settings::from_run(&moved), settings::from_run(&older));
}

/// Changes of a preset and a part of the error, with `\n` for the end of a line.
#[test]
fn errors_name_the_problem() {
    for line in include_str!("errors.txt").lines() {
        let (changes, words) = line.split_once(" => ").unwrap();
        let [changes, words] = [changes, words].map(|text| text.replace("\\n", "\n"));
        let error = one_line(&resolve("hopper-demo", &changes.parse().unwrap()).unwrap_err());
        assert!(error.contains(&words), "{error}");
    }
}
