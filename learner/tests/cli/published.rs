//! `learner report` beside the paper's figures.

use serde_json::{Value, json};

use super::report::{HOPPER, paper, report, report_with};
use crate::run::Run;

#[test]
fn the_papers_protocol_stands_beside_the_papers_figures() {
    // The last five: 1,920,000 to 2,000,000; the last 50,000 steps: 1,960,000 to 2,000,000. An
    // early best one counts nowhere.
    let score = |step| if step == 20_000 { 1000.0 } else { step as f64 / 20_000.0 };
    let reported = report(&paper(HOPPER, 2_000_000, score));
    let group = reported.group();
    assert_eq!(
        (&group["mean_last_5"]["mean"], &group["mean_last_50000_steps"]["mean"]),
        (&json!(99.5), &json!(100.5))
    );
    assert_eq!(
        (&group["departures"], &group["published"][0]["score"]["mean"]),
        (&json!([]), &json!(104.9))
    );
    reported.has_row(&[
        "Table 1 of the paper",
        "divided by n - 1 (in parentheses: by n)",
        "DAC's code",
        "number of seeds n",
    ]);
    reported.has_row(&["task", "ours: quad", "QUAD", "DAC", "IQL"]);
    reported.has_row(&[HOPPER, " 99.50 ± 1.29 (1.12) [1]", " 104.9 ± 0.2 ", " 103.1 ", " 94.7 "]);
    reported.has_row(&["Table 2 of the paper"]);
    reported.has_row(&[HOPPER, " 99.50 ± 1.29 (1.12) [1]", " 104.9 ± 0.2", " 103.4 ± 0.2"]);
    reported.has_row(&["- [1] 4 seeds, 2000000 steps on cpu, scored in f32."]);
    reported.has_row(&["Sources: QUAD: Table 1; DAC: Table 1, from Fang et al. 2024"]);
    assert!(!reported.text.contains("Not its authors'"), "{}", reported.text);
    assert!(reported.markdown.contains("\n| --- |"), "{}", reported.markdown);
}

#[test]
fn what_is_known_of_the_papers_figures_stands_below_them() {
    let reported = report(&paper("antmaze-large-diverse-v0", 20_000, |_| 50.0));
    let published = reported.group()["published"].as_array().unwrap();
    let of = |method: &str| published.iter().find(|figure| figure["method"] == method).unwrap();
    assert_eq!(
        (&of("QUAD")["remarks"], &of("DQL")["remarks"][0]["selected"]),
        (&json!([]), &json!(true))
    );
    reported.has_row(&["antmaze-large-diverse-v0", " 54.0 bcd ", " 66.4 de ", " 14.9 h"]);
    reported.says(&["- a (DQL): selected by test returns: most likely the best of a run's"]);
    reported.has_row(&["- d (AlignIQL, DTQL): AlignIQL's and DTQL's most likely changed places"]);
    reported.has_row(&["- h (CQL): ", "CORL", " 20.5 in antmaze-large-diverse-v0"]);
}

#[test]
fn the_best_evaluation_counts_only_where_it_is_asked_for_and_the_report_says_so() {
    // Of seed s the best evaluation has 1000 + s, at 20,000 steps.
    let runs = paper(HOPPER, 2_000_000, |step| if step == 20_000 { 1000.0 } else { 50.0 });
    let [last, best] = [&[][..], &["--select", "best"]].map(|flags| report_with(&runs, flags));
    assert_eq!((&last.json["select"], &last.group()["best"]), (&json!("last"), &Value::Null));
    assert_eq!(
        (&best.json["select"], &best.group()["best"]["mean"]),
        (&json!("best"), &json!(1001.5))
    );
    assert_eq!(
        best.group()["departures"][0],
        "the best evaluation of each run, not the mean of its last 5"
    );
    let reasons = ["Selected: of each run its best complete evaluation counts", "it is optimistic"];
    best.says(&reasons);
    best.says(&["such selection stands behind those of DQL, EQL, Onestep-RL, as far as is known"]);
    best.has_row(&["task", "best evaluation"]);
    best.has_row(&["Table 1 of the paper", "a run's score is its best evaluation"]);
    best.has_row(&[HOPPER, " 1001.50 ± 1.29 (1.12) [1]"]);
    assert!(
        best.text.contains("mean score of the best evaluation, after 20000 steps: 1003.00"),
        "{}",
        best.text
    );
    for words in reasons.into_iter().chain(["1001.50", "such selection", "after 20000 steps"]) {
        assert!(
            !last.text.contains(words) && !last.markdown.contains(words),
            "{words} in\n{}",
            last.text
        );
    }
}

#[test]
fn what_is_not_the_papers_protocol_is_called_so() {
    let departures = |runs: &[Run]| {
        let reported = report(runs);
        let departures: Vec<String> =
            serde_json::from_value(reported.group()["departures"].clone()).unwrap();
        departures.iter().for_each(|words| reported.says(&[words]));
        departures
    };
    let stopped = &paper(HOPPER, 400_000, |_| 50.0)[..1];
    let changes = [
        ("experiment.dataset", "x.hdf5".into()),
        ("experiment.agent.tau", 1.0.into()),
        ("experiment.scale", vec!["states"].into()),
    ];
    let stopped = stopped[0].clone().set(&changes);
    let expected = [
        "dataset is x.hdf5, not hopper-medium-replay-v2",
        "agent.tau is 1.0, not 0.1",
        "scale is [\"states\"], not []",
        "20 of 100 evaluations are complete, the last of them after 400000 of 2000000 steps",
        "1 of 4 seeds",
    ];
    assert_eq!(departures(std::slice::from_ref(&stopped)), expected);
    // The named file in another place, known by its checksum.
    let sha256 = "e121c5f7c9857a307baa9edc6a2c3b48e85fedb9ac316ecddd0f48ca7ef4e39b";
    assert_eq!(departures(&[stopped.set(&[("dataset.sha256", sha256.into())])]), expected[1..]);

    // What evaluators computed in does not part the seeds, but it is named.
    let mut mixed = paper(HOPPER, 2_000_000, |_| 50.0);
    mixed[1].scores.iter_mut().for_each(|line| line["precision"] = json!("bf16-amx"));
    assert_eq!(departures(&mixed), ["scored in bf16 and f32, not in f32"]);
    mixed
        .iter_mut()
        .flat_map(|run| &mut run.scores)
        .for_each(|line| line["precision"] = json!("bf16-amx"));
    assert_eq!(departures(&mixed), ["scored in bf16, not in f32"]);
}

/// DAC and IQL have rows of their own in the paper's tables; behavior cloning has none.
#[test]
fn another_algorithm_is_compared_with_its_own_authors_values() {
    let guided = |guidance: &str| {
        let runs = paper(HOPPER, 2_000_000, |_| 50.0);
        Vec::from_iter(
            runs.into_iter().map(|run| run.set(&[("experiment.agent.guidance", guidance.into())])),
        )
    };
    let reported = report(&guided("dac"));
    assert_eq!(reported.group()["departures"], json!([]), "{}", reported.text);
    reported.has_row(&["ours: dac", "DAC-Rep"]);
    reported.has_row(&[HOPPER, " 51.50 "]);
    let reported = report(&guided("none"));
    assert_eq!(reported.group()["departures"], json!(["agent.guidance is \"none\", not \"quad\""]));

    let mut iql = Run::by("iql", HOPPER, 0).set(&[("experiment.agent.expectile", 0.8.into())]);
    (0..10).for_each(|episode| iql.score(5_000, episode, 50.0, "00"));
    let reported = report(&[iql, paper(HOPPER, 100_000, |_| 50.0).remove(0)]);
    let [iql, quad] = &reported.json["groups"].as_array().unwrap()[..] else {
        panic!("{}", reported.text)
    };
    assert_eq!(
        (&iql["methods"], &iql["departures"][0]),
        (&json!(["IQL"]), &json!("agent.expectile is 0.8, not 0.7"))
    );
    assert_eq!(
        (&iql["differs"], &quad["differs"]),
        (&json!([]), &json!([])),
        "of other algorithms nothing is expected"
    );
    reported.has_row(&["ours: iql", "ours: quad"]);
    reported.has_row(&[HOPPER, " - [1] ", " - [2] "]);
    reported.has_row(&["- [2] 1 seed, 100000 of 2000000 steps (not complete) on cpu"]);
}

/// OGBench's and CORL's figures stand in tables of their own, beside runs that are scored as
/// OGBench's are.
#[test]
fn what_others_publish_stands_beside_runs_of_their_tasks() {
    let task = "cube-single-play-singletask-v0";
    let mut run = Run::by("fql", task, 0).set(&[("experiment.episodes", 1.into())]);
    (1..=10).for_each(|n| run.score(100_000 * n, 0, n as f64, "00"));
    let reported = report(&[run]);
    reported.has_row(&[
        "OGBench's default tasks. Ours: ",
        "a run's score is the mean of its last 3 evaluations.",
    ]);
    reported.has_row(&["task", "ours: fql", "BC", "IQL", "ReBRAC", "IDQL", "IFQL", "FQL"]);
    reported.has_row(&[task, " 9.00 ", " 5.0 a ", " 85.0 b ", " 92.0 bc ", " 97.0 b"]);
    reported.has_row(&[
        "- [1] 1 seed, ",
        "Not its authors' protocol: episodes is 1, not 50; 1 of 8 seeds",
    ]);
    reported.has_row(&["- Sources: BC, IQL, ReBRAC, IDQL, IFQL, FQL: Park, Li and Levine 2025."]);
    reported.says(&["- b (IQL, ReBRAC, IFQL, FQL): selected by test returns: weights such as"]);

    let reported = report(&[Run::by("td3-bc", "hopper-medium-v2", 0)]);
    reported.has_row(&["task", "ours: td3-bc", "TD3+BC", "ReBRAC"]);
    reported.has_row(&["hopper-medium-v2", " - [1] ", " 60.4 ± 3.5 a ", " 102.3 ± 0.2 b"]);
    assert!(!reported.text.contains("Table 1"), "{}", reported.text);
}

#[test]
fn a_complete_run_stands_in_the_table_before_one_that_is_not() {
    let runs = [paper(HOPPER, 400_000, |_| 30.0), paper(HOPPER, 2_000_000, |_| 50.0)].concat();
    report(&runs).has_row(&[HOPPER, " 51.50 ± 1.29 (1.12) [1]"]);
}
