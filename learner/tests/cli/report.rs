//! What `learner report` says of runs.

use std::collections::BTreeMap;
use std::fs;

use serde_json::{Value, json};

use crate::printed;
use crate::run::Run;

/// What is reported of runs, which lie in folders a, b, …
pub(super) struct Reported {
    pub(super) json: Value,
    pub(super) text: String,
    pub(super) markdown: String,
    /// The pictures, by the names of their files.
    pub(super) figures: BTreeMap<String, Vec<u8>>,
}

pub(super) fn report(runs: &[Run]) -> Reported {
    report_with(runs, &[])
}

pub(super) fn report_with(runs: &[Run], flags: &[&str]) -> Reported {
    let folder = tempfile::tempdir().unwrap();
    let paths: Vec<_> =
        ('a'..='z').take(runs.len()).map(|name| folder.path().join(name.to_string())).collect();
    runs.iter().zip(&paths).for_each(|(run, path)| run.write(path));
    let figures = folder.path().join("figures");
    let print = |form: &[&str]| {
        let paths = paths.iter().map(|path| path.to_str().unwrap());
        printed(
            &["report"]
                .into_iter()
                .chain(paths)
                .chain(flags.iter().chain(form).copied())
                .collect::<Vec<_>>(),
        )
    };
    let json =
        serde_json::from_str(&print(&["--json", "--figures", figures.to_str().unwrap()])).unwrap();
    let read = |name: fs::DirEntry| {
        (name.file_name().into_string().unwrap(), fs::read(name.path()).unwrap())
    };
    let figures = fs::read_dir(figures).unwrap().map(|entry| read(entry.unwrap())).collect();
    Reported { json, text: print(&[]), markdown: print(&["--markdown"]), figures }
}

impl Reported {
    /// The only group of runs.
    pub(super) fn group(&self) -> &Value {
        let groups = self.json["groups"].as_array().unwrap();
        assert_eq!(groups.len(), 1, "{}", self.text);
        &groups[0]
    }

    /// A picture that is text.
    pub(super) fn svg(&self, name: &str) -> &str {
        str::from_utf8(&self.figures[name]).unwrap()
    }

    /// Asserts that both forms of the report say this.
    pub(super) fn says(&self, words: &[&str]) {
        for text in [&self.text, &self.markdown] {
            words
                .iter()
                .for_each(|words| assert!(text.contains(words), "{words} is missing in\n{text}"));
        }
    }

    /// Asserts that both have a line with all these words.
    pub(super) fn has_row(&self, words: &[&str]) {
        for text in [&self.text, &self.markdown] {
            let has_all = |line: &str| words.iter().all(|word| line.contains(word));
            assert!(text.lines().any(has_all), "a line with {words:?} is missing in\n{text}");
        }
    }
}

/// A run of 6,000 steps with an evaluation of two episodes every thousand: complete ones with means
/// 2, 4, 6, 8, 10 (+ shift), each ± √2, and half of a sixth.
fn small(seed: u64, shift: f64) -> Run {
    let [steps, eval_interval, episodes] = [6000, 1000, 2].map(toml::Value::from);
    let mut run = Run::new("hopper-demo", seed).set(&[
        ("experiment.steps", steps),
        ("experiment.eval_interval", eval_interval),
        ("experiment.episodes", episodes),
    ]);
    for n in 1..=5 {
        let mean = 2.0 * n as f64 + shift;
        run.score(1000 * n, 0, mean - 1.0, "00");
        run.score(1000 * n, 1, mean + 1.0, "00");
    }
    run.score(6000, 1, 99.0, "00");
    run
}

/// Four runs of one of the paper's tasks, with a score of each evaluation up to `last`.
pub(super) fn paper(task: &str, last: u64, score: impl Fn(u64) -> f64) -> Vec<Run> {
    let run = |seed| {
        let mut run = Run::new(task, seed);
        for step in (20_000..=last).step_by(20_000) {
            (0..10).for_each(|episode| run.score(step, episode, score(step) + seed as f64, "00"));
        }
        run
    };
    (0..4).map(run).collect()
}

pub(super) const HOPPER: &str = "hopper-medium-replay-v2";

#[test]
fn a_run_is_summarized_by_its_complete_evaluations_and_says_how_many_there_are() {
    let reported = report(&[small(3, 0.0)]);
    let run = &reported.json["runs"][0];
    assert_eq!(
        (&run["variant"], &run["seed"], &run["dataset_score"]),
        (&json!("quad"), &json!(3), &json!(10.7))
    );
    assert_eq!((&run["mean_last_3"], &run["mean_last_5"]), (&json!(8.0), &json!(6.0)));
    assert_eq!(run["episodes_missing"], json!(1));
    let fifth = &run["evaluations"][4];
    assert_eq!((&fifth["score"]["mean"], &fifth["mean_return"]), (&json!(10.0), &json!(100.0)));
    for words in [
        "10.00 ± 1.41",
        "1 (part)",
        "last 3 evaluations: 8.00",
        "last 5 evaluations: 6.00",
        "dataset:            10.70",
        "scored in f32",
        "1 episodes have no score: 5 of 6 evaluations are complete, the last of them after 5000 of 6000 steps",
    ] {
        assert!(reported.text.contains(words), "{words} is missing in\n{}", reported.text);
    }
}

#[test]
fn a_run_that_is_not_complete_is_marked_and_not_averaged_with_complete_ones() {
    let [mut complete, mut stopped] = [small(0, 0.0), small(1, 0.0)];
    complete.score(6000, 0, 12.0, "00");
    stopped.scores.truncate(4);
    let reported = report(&[complete, stopped]);
    let [complete, stopped] = &reported.json["groups"].as_array().unwrap()[..] else {
        panic!("{}", reported.json)
    };
    assert_eq!((&complete["seeds"], &complete["reached"]), (&json!([0]), &Value::Null));
    assert_eq!(
        (&stopped["seeds"], &stopped["reached"], &stopped["scores"]),
        (&json!([1]), &json!(2000), &json!([]))
    );
    let words = "2 of 6 evaluations are complete, the last of them after 2000 of 6000 steps";
    assert!(stopped["unfinished"][0].as_str().unwrap().ends_with(words), "{stopped}");
    reported.has_row(&["Not complete, and in no other figure: ", words]);
    reported.has_row(&["hopper-demo", "2000 of 6000 steps (not complete)"]);
    assert_eq!(reported.json["study"][0]["seeds"], json!([0]));
    assert!(reported.svg("curve-hopper-demo.svg").contains("quad (1 seed, not complete)"));
}

#[test]
fn unlike_runs_are_no_seeds_of_each_other_and_the_report_says_what_differs() {
    for (key, value, differs) in [
        ("experiment.agent.tau", 0.5.into(), &["agent.tau = 0.1", "agent.tau = 0.5"][..]),
        (
            "experiment.agent.candidates",
            1.into(),
            &["agent.candidates = 10", "agent.candidates = 1"],
        ),
        ("run.device", "cuda".into(), &["device = cpu", "device = cuda"]),
        (
            "dataset.mean_return",
            21.0.into(),
            &["dataset.mean_return = 20.0", "dataset.mean_return = 21.0"],
        ),
        (
            "experiment.agent.eta.threshold",
            1.0.into(),
            &["no agent.eta.threshold", "agent.eta.threshold = 1.0"],
        ),
        ("experiment.reward", "as-is".into(), &["reward = \"locomotion\"", "reward = \"as-is\""]),
        ("experiment.scale", vec!["states"].into(), &["scale = []", "scale = [\"states\"]"]),
        // The same file in another place.
        ("dataset.path", "elsewhere.hdf5".into(), &[]),
        ("experiment.dataset", "elsewhere.hdf5".into(), &[]),
    ] {
        let reported = report(&[small(0, 0.0), small(1, 0.0).set(&[(key, value)])]);
        let groups = reported.json["groups"].as_array().unwrap();
        let found: Vec<_> =
            groups.iter().flat_map(|group| group["differs"].as_array().unwrap()).collect();
        assert_eq!(
            found,
            differs
                .iter()
                .map(|&words| json!(words))
                .collect::<Vec<_>>()
                .iter()
                .collect::<Vec<_>>()
        );
        assert_eq!(groups.len(), 1.max(differs.len()));
        reported.says(differs);
    }
}

#[test]
fn a_seed_counts_once_and_a_run_without_a_complete_evaluation_not_at_all() {
    let mut unscored = small(1, 0.0);
    unscored.scores.clear();
    let reported = report(&[small(0, 0.0), small(0, 4.0), unscored]);
    let group = reported.group();
    assert_eq!(
        (&group["seeds"], &group["mean_last_5"]["mean"]),
        (&json!([0]), &json!(6.0)),
        "the first is counted"
    );
    reported.has_row(&["Not counted: ", "b has seed 0 like "]);
    reported.has_row(&["Not counted: ", "c has no complete evaluation"]);
    assert!(reported.text.contains("no evaluation has a score yet"), "{}", reported.text);
}

#[test]
fn the_number_of_goals_stands_beside_the_score_where_a_run_has_one() {
    let reported = report(&paper("antmaze-umaze-v0", 100_000, |_| 50.0));
    assert_eq!(reported.group()["goals"], json!(4));
    reported.says(&[
        "4, 4 goals",
        "4 seeds with a goal each",
        "one goal a run: 4 behind this ±",
        "asks for 50 to 100 seeds",
    ]);
    let reported = report(&paper(HOPPER, 100_000, |_| 50.0));
    assert!(
        reported.group()["goals"].is_null() && !reported.text.contains("goal"),
        "{}",
        reported.text
    );
}

#[test]
fn scores_without_references_are_called_returns_unless_they_are_something_else() {
    let mut run = small(0, 0.0).set(&[("experiment.environment", "my-robot".into())]);
    run.config["dataset"].as_table_mut().unwrap().remove("mean_score");
    let Reported { text, .. } = report(std::slice::from_ref(&run));
    assert!(text.contains("score  return") && text.contains("mean score of the last 5"), "{text}");
    assert!(!text.contains("of the dataset"), "{text}");
    for line in &mut run.scores {
        line["return"] = line["score"].clone();
    }
    let reported = report(&[run]);
    let text = &reported.text;
    assert!(text.contains("mean return of the dataset") && !text.contains("score "), "{text}");
    assert!(!reported.svg("curve-hopper-demo.svg").contains("normalized"));
}

#[test]
fn a_page_holds_all_that_is_shown_and_takes_nothing_for_html() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let dataset = "<script>alert(1)</script>.hdf5";
    small(3, 0.0).set(&[("experiment.dataset", dataset.into())]).write(&folder.path().join("a"));
    small(4, 1.0).write(&folder.path().join("b"));
    fs::write(path("a/film.gif"), "GIF89a of a run").unwrap();
    printed(&["report", &path("a"), &path("b"), "--html", &path("page.html")]);
    let page = fs::read_to_string(path("page.html")).unwrap().replace("&#x2f;", "/");
    assert!(!page.contains("<script") && page.contains("&lt;script&gt;alert(1)"), "{page}");
    // Nothing is fetched: neither scripts nor pictures have addresses.
    assert!(
        !page.contains("href=\"http") && !page.contains("src=\"/") && !page.contains("url("),
        "{page}"
    );
    let film = "src=\"data:image/gif;base64,R0lGODlhIG9mIGEgcnVu\"";
    let command = format!("--seed 4 --run-dir {}", path("b"));
    for words in [
        "<svg",
        film,
        &command,
        "8.50 ± 0.71 (0.50)",
        "steps = 6000",
        "100 transitions of 3 episodes",
    ] {
        assert!(page.contains(words), "{words} is missing in\n{page}");
    }
}

#[test]
fn the_last_steps_of_a_run_do_not_reach_back_to_the_evaluation_before_them() {
    let numbers = [
        ("experiment.steps", 100_000),
        ("experiment.eval_interval", 10_000),
        ("experiment.episodes", 2),
    ];
    let mut run =
        Run::new("hopper-demo", 0).set(&numbers.map(|(key, number)| (key, number.into())));
    for n in 1..=10 {
        (0..2).for_each(|episode| run.score(10_000 * n, episode, n as f64, "00"));
    }
    // 6 to 10: the evaluation after 50,000 steps is none of the last 50,000.
    assert_eq!(report(&[run]).json["runs"][0]["mean_last_50000_steps"], json!(8.0));
}

#[test]
fn of_equally_good_evaluations_the_last_is_the_best() {
    let mut run = small(0, 0.0);
    (0..2).for_each(|episode| run.score(7000, episode, 10.0, "00"));
    let text = report_with(&[run], &["--select", "best"]).text;
    assert!(text.contains("best evaluation, after 7000 steps: 10.00"), "{text}");
}

#[test]
fn a_part_of_an_evaluation_is_in_no_curve() {
    let runs = [small(0, 0.0), small(1, 1.0)];
    let without_part = runs.clone().map(|mut run| {
        run.scores.pop();
        run
    });
    let [with, without] = [report(&runs), report(&without_part)];
    assert_eq!(with.svg("curve-hopper-demo.svg"), without.svg("curve-hopper-demo.svg"));
}
