//! Tests of judgments.

use super::*;
use crate::table::Style;

fn estimate(values: &[f64]) -> Estimate {
    Estimate { values: values.to_vec(), doubts: Vec::new() }
}

fn pair(a: [f64; 2], b: [f64; 2], behavior: f64) -> Vec<Judgment> {
    vec![judgment("a", &a, behavior), judgment("b", &b, behavior)]
}

fn judgment(run: &str, values: &[f64], behavior: f64) -> Judgment {
    let conditions = Conditions {
        dataset: "abc".to_owned(),
        environment: "arm".to_owned(),
        episodes: vec![3, 5],
        gamma: 0.99,
        steps: 100,
        seeds: 2,
    };
    Judgment {
        run: run.into(),
        step: 20,
        weights: String::new(),
        conditions,
        estimate: estimate(values),
        distance: 1.0,
        unseen: true,
        caveat: None,
        behavior: estimate(&[behavior, behavior]),
        recorded: 10.0,
    }
}

fn save(run: &RunDir, step: u64, value: f64) {
    let mut judgment = judgment("a", &[value], 10.0);
    judgment.step = step;
    judgment.save(run).unwrap();
}

/// The order of the runs, whether they can be ranked, and the verdict.
fn ranked(judgments: &[Judgment]) -> (Vec<String>, bool, String) {
    let [ranking] =
        <[Ranking; 1]>::try_from(Ranking::from_judgments(judgments.to_vec())).ok().unwrap();
    let runs = ranking.policies.iter().map(|one| one.run.display().to_string());
    (runs.collect(), ranking.can_rank, ranking.verdict)
}

#[test]
fn the_best_comes_first_and_unreliable_estimates_last() {
    let mut diverged = judgment("diverged", &[1e9, 12.0], 10.5);
    diverged.estimate.doubts.push("beyond what rewards allow".to_owned());
    let low = judgment("low", &[9.0, 9.2], 10.5);
    let high = judgment("high", &[13.0, 14.0], 10.5);
    let judgments = [low, diverged, high];
    let (order, can_rank, verdict) = ranked(&judgments);
    assert_eq!((&*order.join(" "), can_rank), ("high low diverged", true));
    // The root mean square of the deviations 0.71 and 0.14 is 0.51, twice that 1.02.
    assert!(verdict.contains("less than 1.02") && verdict.contains("0.50 off"), "{verdict}");
    let blocks = Ranking::from_judgments(judgments.to_vec())[0].blocks();
    let text = blocks.map(|block| block.render(Style::Text)).concat();
    for words in ["a ranking, not a score", "13.50 ± 0.71", "beyond what rewards allow"] {
        assert!(text.contains(words), "{text}");
    }
    assert!(!text.contains("500000006"), "{text}");
}

#[test]
fn close_or_doubtful_values_are_not_ranked() {
    let mut doubtful = judgment("a", &[9.0], 10.0);
    doubtful.behavior.doubts.push("it moves".to_owned());
    for (policies, expected, words) in [
        (pair([9.0, 9.0], [12.0, 12.0], 14.0), false, "4.00 off"),
        (pair([8.0, 10.0], [12.0, 14.0], 10.0), true, ""),
        (pair([8.0, 12.0], [12.0, 14.0], 10.0), false, "no more than 3.00"),
        (vec![doubtful.clone(), doubtful], false, "doubtful"),
        (vec![judgment("alone", &[9.0], 10.0)], false, "One value"),
    ] {
        let (_, can_rank, verdict) = ranked(&policies);
        assert!(can_rank == expected && verdict.contains(words), "{verdict}");
    }
}

#[test]
fn other_conditions_have_another_ranking() {
    let [a, b] = ["a", "b"].map(|run| judgment(run, &[1.0], 10.0));
    let mut different = [a.clone(), a.clone()];
    different[0].conditions.gamma = 0.9;
    different[1].conditions.environment = "another arm".to_owned();
    for other in different {
        assert_eq!(Ranking::from_judgments([a.clone(), other, b.clone()]).len(), 2);
    }
}

#[test]
fn a_judgment_replaces_an_earlier_one_of_its_step_and_conditions() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    for (step, value) in [(40, 1.0), (20, 2.0), (40, 3.0)] {
        save(&run, step, value);
    }
    let saved = Judgment::read_all(&run).unwrap();
    let values = saved.iter().map(|one| (one.step, one.estimate.values[0]));
    assert_eq!(Vec::from_iter(values), [(20, 2.0), (40, 3.0)]);

    let steps = || Vec::from_iter(Judgment::read_all(&run).unwrap().iter().map(|one| one.step));
    let mut other = saved[1].clone();
    other.conditions.gamma = 0.9;
    other.save(&run).unwrap();
    assert_eq!(steps(), [20, 40, 40]);
    // The snapshot was made again.
    other.weights = "00".to_owned();
    other.save(&run).unwrap();
    assert_eq!(steps(), [20, 40]);
}

#[test]
fn concurrent_judges_lose_no_judgment() {
    let folder = tempfile::tempdir().unwrap();
    let run = &RunDir::at(folder.path());
    std::thread::scope(|scope| {
        for judge in 0..4 {
            scope.spawn(move || (5 * judge..5 * judge + 5).for_each(|step| save(run, step, 1.0)));
        }
    });
    let saved = Judgment::read_all(run).unwrap();
    assert_eq!(Vec::from_iter(saved.iter().map(|one| one.step)), Vec::from_iter(0..20));
}

#[test]
fn judgments_of_unknown_environments_do_not_count() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    let mut written = serde_json::to_value([judgment("a", &[1.0], 10.0)]).unwrap();
    written[0]["conditions"].as_object_mut().unwrap().remove("environment");
    run.write_json(FILE, &written).unwrap();
    assert_eq!(Judgment::read_all(&run).unwrap(), []);
}
