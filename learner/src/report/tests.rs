//! Reports on run folders as learners write them.

use std::fs;
use std::path::{Path, PathBuf};

use quad_dataset::RewardRule;

use super::{Report, RunReport, learning_curves};
use crate::config::{Device, RunConfig};
use crate::run::ScoreLine;

fn line(step: u64, seed: u64, score: f64) -> ScoreLine {
    ScoreLine {
        step,
        seed,
        episode_return: 10.0 * score,
        length: 5,
        score,
        weights: "00".into(),
        precision: "f32-avx2".into(),
        evaluator: "e".into(),
    }
}

fn write(path: &Path, config: &RunConfig, lines: &[ScoreLine]) {
    fs::create_dir_all(path).unwrap();
    fs::write(path.join("config.toml"), toml::to_string(config).unwrap()).unwrap();
    let lines = lines.iter().map(|line| serde_json::to_string(line).unwrap() + "\n");
    fs::write(path.join("scores.jsonl"), lines.collect::<String>()).unwrap();
}

/// A run of 6,000 steps with an evaluation of two episodes every thousand.
fn small(seed: u64) -> RunConfig {
    let mut config = RunConfig::example("hopper-demo", seed);
    let experiment = &mut config.experiment;
    (experiment.steps, experiment.eval_interval, experiment.episodes) = (6000, 1000, 2);
    config
}

/// Complete evaluations with means 2, 4, 6, 8, 10 (+ shift), each ± √2, and half of a sixth.
fn small_scores(shift: f64) -> Vec<ScoreLine> {
    let mean = |n: u64| 2.0 * n as f64 + shift;
    let complete = (1..=5).flat_map(|n| [line(1000 * n, 0, mean(n) - 1.0), line(1000 * n, 1, mean(n) + 1.0)]);
    let mut lines: Vec<_> = complete.collect();
    lines.push(line(6000, 1, 99.0));
    lines
}

/// The report on runs of these configurations and scores, in folders a, b, …
fn report(runs: &[(RunConfig, Vec<ScoreLine>)]) -> Report {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<PathBuf> = ('a'..='z').take(runs.len()).map(|name| folder.path().join(name.to_string())).collect();
    for (path, (config, lines)) in paths.iter().zip(runs) {
        write(path, config, lines);
    }
    Report::read(&paths).unwrap()
}

/// Runs of one of the paper's presets, with seeds 0, 1, …, and a score of each evaluation up to `last`.
fn paper(preset: &str, seeds: u64, last: u64, score: impl Fn(u64) -> f64) -> Vec<(RunConfig, Vec<ScoreLine>)> {
    let run = |seed| {
        let steps = (20_000..=last).step_by(20_000);
        let episodes = steps.flat_map(|step| (0..10).map(move |episode| (step, episode)));
        let lines = episodes.map(|(step, episode)| line(step, episode, score(step) + seed as f64)).collect();
        (RunConfig::example(preset, seed), lines)
    };
    (0..seeds).map(run).collect()
}

const HOPPER: &str = "hopper-medium-replay-v2";

#[test]
fn a_run_is_summarised_by_its_complete_evaluations_and_says_how_many_there_are() {
    let report = report(&[(small(3), small_scores(0.0))]);
    let run = &report.runs[0];
    assert_eq!((run.seed, &*run.variant, run.candidates, run.dataset_score), (3, "quad", 10, 10.7));
    let [.., fifth, last] = &run.evaluations[..] else { panic!("{:?}", run.evaluations) };
    assert_eq!((last.step, last.episodes, last.complete, last.score.std), (6000, 1, false, None));
    assert_eq!((fifth.score.mean, fifth.mean_return, fifth.mean_length, fifth.complete), (10.0, 100.0, 5.0, true));
    assert!((fifth.score.std.unwrap() - 2f64.sqrt()).abs() < 1e-12);
    assert_eq!((run.mean_last_3, run.mean_last_5), (Some(8.0), Some(6.0)));
    assert_eq!(run.missing.iter().map(|missing| (missing.step, missing.episodes)).collect::<Vec<_>>(), [(6000, 1)]);
    for text in [
        "10.00 ± 1.41",
        "1 (part)",
        "last 3 evaluations: 8.00",
        "last 5 evaluations: 6.00",
        "dataset:            10.70",
        "scored in f32",
        "1 episodes have no score: 5 of 6 evaluations are complete, the last of them after 5000 of 6000 steps",
    ] {
        assert!(run.table().contains(text), "{text} is missing in\n{}", run.table());
    }
}

#[test]
fn several_runs_are_summarised_over_seeds_with_both_deviations() {
    let report = report(&[(small(0), small_scores(0.0)), (small(1), small_scores(4.0))]);
    let [group] = &report.groups[..] else { panic!("one group, not {:?}", report.groups) };
    assert_eq!((&group.seeds[..], group.mean_last_3.unwrap().mean), (&[0, 1][..], 10.0));
    for text in [report.text(), report.markdown()] {
        assert!(text.contains("10.00 ± 2.83 (2.00)") && text.contains("divided by n - 1"), "{text}");
    }
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["runs"][1]["evaluations"][0]["score"]["mean"], 6.0);
    let spread = &json["groups"][0]["mean_last_3"];
    assert_eq!((&spread["population_std"], spread["std"].as_f64().unwrap().round()), (&2.0.into(), 3.0));
}

#[test]
fn a_run_that_is_not_complete_is_marked_over_seeds() {
    let complete = || [small_scores(0.0), vec![line(6000, 0, 12.0)]].concat();
    let stopped = complete()[..4].to_vec();
    let report = report(&[(small(0), complete()), (small(1), stopped)]);
    let note = "2 of 6 evaluations are complete, the last of them after 2000 of 6000 steps";
    assert!(report.groups[0].unfinished[0].ends_with(note), "{:?}", report.groups[0].unfinished);
    assert_eq!(report.groups[0].unfinished.len(), 1);
    for text in [report.text(), report.markdown()] {
        assert!(text.contains("Not complete: in ") && text.contains(note), "{text}");
    }
}

#[test]
fn unlike_runs_are_no_seeds_of_each_other_and_the_report_says_what_differs() {
    type Change = (&'static [&'static str], fn(&mut RunConfig));
    let beside_a_plain_run = |change: fn(&mut RunConfig)| {
        let mut config = small(1);
        change(&mut config);
        report(&[(small(0), small_scores(0.0)), (config, small_scores(0.0))])
    };
    let changes: [Change; 7] = [
        (&["agent.tau = 0.1", "agent.tau = 0.5"], |config| {
            drop(config.experiment.agent.insert("tau".into(), 0.5.into()))
        }),
        (&["candidates = 10", "candidates = 1"], |config| config.experiment.candidates = 1),
        (&["device = cpu", "device = cuda"], |config| config.run.device = Device::Cuda),
        (&["dataset.mean_return = 20.0", "dataset.mean_return = 21.0"], |config| config.dataset.mean_return = 21.0),
        (&["no agent.eta.threshold", "agent.eta.threshold = 1.0"], |config| {
            config.experiment.agent["eta"].as_table_mut().unwrap().insert("threshold".into(), 1.0.into());
        }),
        (&["reward = \"locomotion\"", "reward = \"as-is\""], |config| config.experiment.reward = RewardRule::AsIs),
        // The same file in another place.
        (&[], |config| {
            config.dataset.path = "elsewhere.hdf5".into();
            config.experiment.dataset = Some("elsewhere.hdf5".into());
        }),
    ];
    for (keys, change) in changes {
        let report = beside_a_plain_run(change);
        let differs: Vec<_> = report.groups.iter().flat_map(|group| &group.differs).collect();
        assert_eq!(differs, keys);
        assert_eq!(report.groups.len(), 1.max(keys.len()));
        assert!(keys.iter().all(|key| report.text().contains(key)), "{}", report.text());
    }
    let report = beside_a_plain_run(|config| config.dataset.sha256 = Some("00".into()));
    assert_eq!(report.groups.len(), 2, "of one of them the contents are known");
}

#[test]
fn a_seed_counts_once_and_a_run_without_a_complete_evaluation_not_at_all() {
    let report = report(&[(small(0), small_scores(0.0)), (small(0), small_scores(4.0)), (small(1), vec![])]);
    assert_eq!((&report.groups[0].seeds[..], report.groups.len()), (&[0][..], 1));
    assert_eq!(report.groups[0].mean_last_5.unwrap().mean, 6.0, "the first is counted");
    let text = report.text();
    assert!(text.contains("b has seed 0 like") && text.contains("c has no complete evaluation"), "{text}");
    assert!(report.runs[2].table().contains("no evaluation has a score yet"));
}

#[test]
fn the_papers_protocol_stands_beside_the_papers_figures() {
    // The last five: 1,920,000 to 2,000,000; the last 50,000 steps: 1,960,000 to 2,000,000. An early best one counts nowhere.
    let score = |step| if step == 20_000 { 1000.0 } else { step as f64 / 20_000.0 };
    let report = report(&paper(HOPPER, 4, 2_000_000, score));
    let [group] = &report.groups[..] else { panic!("one group, not {:?}", report.groups) };
    assert_eq!((group.mean_last_5.unwrap().mean, group.mean_last_50000_steps.unwrap().mean), (99.5, 100.5));
    assert_eq!(group.departures, [] as [&str; 0]);
    for text in [report.text(), report.markdown()] {
        let row = |words: &[&str]| text.lines().any(|line| words.iter().all(|word| line.contains(word)));
        assert!(
            row(&["ours: quad", " 99.50 ", " 1.12 ", " 1.29 ", "last 5 evaluations; 4 seeds, 2000000 steps"]),
            "{text}"
        );
        assert!(row(&["ours: quad", " 100.50 ", "last 50000 steps", "on cpu, scored in f32"]), "{text}");
        assert!(
            row(&["± by n ", "± by n - 1"]) && row(&["QUAD", " 104.9 ", " 0.2 ", "Table 1"]) && row(&["IQL"]),
            "{text}"
        );
        assert!(text.contains("divides by the number of seeds") && !text.contains("Not the paper's"), "{text}");
    }
    assert!(report.markdown().contains("\n| --- |"), "{}", report.markdown());
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["groups"][0]["published"][0]["score"]["mean"], 104.9);
}

#[test]
fn what_is_not_the_papers_protocol_is_called_so() {
    let departures = |runs: &[(RunConfig, Vec<ScoreLine>)]| {
        let report = report(runs);
        let [group] = &report.groups[..] else { panic!("one group, not {:?}", report.groups) };
        assert!(group.departures.iter().all(|words| report.text().contains(words)), "{}", report.text());
        group.departures.clone()
    };
    let mut stopped = paper(HOPPER, 1, 400_000, |_| 50.0);
    let config = &mut stopped[0].0;
    config.experiment.dataset = Some("x.hdf5".into());
    config.experiment.agent.insert("tau".into(), 1.0.into());
    let expected = [
        "dataset is x.hdf5, not hopper-medium-replay-v2",
        "agent.tau is 1.0, not 0.1",
        "20 of 100 evaluations are complete, the last of them after 400000 of 2000000 steps",
        "1 of 4 seeds",
    ];
    assert_eq!(departures(&stopped), expected);
    // The named file in another place, known by its checksum.
    stopped[0].0.dataset.sha256 = Some("e121c5f7c9857a307baa9edc6a2c3b48e85fedb9ac316ecddd0f48ca7ef4e39b".into());
    assert_eq!(departures(&stopped), expected[1..]);

    // What evaluators computed in does not part the seeds, but it is named.
    let mut mixed = paper(HOPPER, 4, 2_000_000, |_| 50.0);
    mixed[1].1.iter_mut().for_each(|line| line.precision = "bf16-amx".into());
    assert_eq!(departures(&mixed), ["scored in bf16 and f32, not in f32"]);
    mixed.iter_mut().flat_map(|(_, lines)| lines).for_each(|line| line.precision = "bf16-amx".into());
    assert_eq!(departures(&mixed), ["scored in bf16, not in f32"]);
}

#[test]
fn the_number_of_goals_stands_beside_the_score_where_a_run_has_one() {
    let goals = |preset| {
        let report = report(&paper(preset, 4, 100_000, |_| 50.0));
        (report.groups[0].goals, report.text())
    };
    let (four, text) = goals("antmaze-umaze-v0");
    assert_eq!(four, Some(4));
    for words in ["4, 4 goals", "4 seeds with a goal each", "4 goals stand behind the ±", "50 to 100 seeds"] {
        assert!(text.contains(words), "{words} is missing in\n{text}");
    }
    let (none, text) = goals(HOPPER);
    assert!(none.is_none() && !text.contains("goal"), "{text}");
}

#[test]
fn scores_without_references_are_called_returns() {
    let mut config = small(0);
    config.experiment.environment = "my-robot".into();
    config.dataset.mean_score = None;
    let report = report(&[(config, small_scores(0.0))]);
    let text = report.text();
    assert!(text.contains("mean return of the dataset") && !text.contains("score "), "{text}");
    assert!(!picture(&report.runs).contains("normalised"));
}

fn picture(runs: &[RunReport]) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("curve.svg");
    learning_curves(&path, runs).unwrap();
    fs::read_to_string(path).unwrap()
}

#[test]
fn a_picture_shows_the_curves_and_the_reference() {
    let runs = report(&[(small(0), small_scores(0.0)), (small(1), small_scores(4.0)), (small(2), vec![])]).runs;
    let (one, both) = (picture(&runs[..1]), picture(&runs[..2]));
    for text in ["<svg", "gradient steps", "dataset mean 10.7", "<polygon"] {
        assert!(one.contains(text), "{text} is missing");
    }
    assert!(both.contains("(quad, 10 candidates)") && both.matches("<circle").count() > one.matches("<circle").count());
    assert!(picture(&runs[2..]).contains("<svg"), "a run without scores has a picture, too");
}
