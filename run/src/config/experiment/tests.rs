//! Tests of experiments.

use crate::config::{DatasetInfo, RunConfig, resolve, settings};
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
fn a_single_file_is_written_as_text_and_several_as_a_list() {
    for (given, files) in [("'a'", vec!["a"]), ("['a']", vec!["a"]), ("['a', 'b']", vec!["a", "b"])]
    {
        let experiment = resolve("hopper-demo", &format!("dataset = {given}").parse().unwrap());
        let experiment = experiment.unwrap();
        assert_eq!(experiment.dataset, files);
        let written = Table::try_from(&experiment).unwrap();
        assert_eq!(written["dataset"].is_str(), files.len() == 1);
        assert_eq!(resolve("hopper-demo", &written).unwrap(), experiment);
    }
}

#[test]
fn older_runs_learned_from_one_file_whose_hash_counts_now() {
    let numbers =
        "transitions = 9\nepisodes = 3\nmin_return = 0.0\nmean_return = 1.0\nmax_return = 2.0";
    let older = format!("path = 'a.hdf5'\nsha256 = '00ff'\n{numbers}");
    let older: DatasetInfo = toml::from_str(&older).unwrap();
    let written = toml::to_string(&older).unwrap();
    let expected =
        "[[files]]\npath = \"a.hdf5\"\nsha256 = \"00ff\"\ntransitions = 9\nepisodes = 3\n";
    assert!(written.ends_with(expected), "{written}");
    assert_eq!(toml::from_str::<DatasetInfo>(&written).unwrap(), older);

    let config = |dataset: DatasetInfo| RunConfig { dataset, ..crate::fixtures::config("run", 0) };
    let mut moved = older.clone();
    moved.files[0].path = "b.hdf5".into();
    let [older, moved] = [older, moved].map(|dataset| settings::from_run(&config(dataset)));
    assert_eq!(older["dataset.sha256"], "\"00ff\"");
    assert_eq!(settings::differences(&older, &moved).count(), 0);
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
