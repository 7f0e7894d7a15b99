//! Tests of judgments: how they rank, and how they are kept.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::table::Style;

fn estimate(values: &[f64]) -> Estimate {
    Estimate { values: values.to_vec(), doubts: Vec::new() }
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
        behavior: estimate(&[behavior, behavior]),
        recorded: 10.0,
    }
}

fn ranked(judgments: &[Judgment]) -> (Vec<String>, bool, String) {
    let [ranking] = <[Ranking; 1]>::try_from(Ranking::of(judgments.to_vec())).ok().unwrap();
    (
        ranking.policies.iter().map(|one| one.run.display().to_string()).collect(),
        ranking.can_rank,
        ranking.verdict,
    )
}

#[test]
fn the_best_comes_first_and_what_diverged_is_told_but_not_averaged() {
    let mut diverged = judgment("diverged", &[1e9, 12.0], 10.5);
    diverged.estimate.doubts.push("beyond what rewards allow".to_owned());
    let judgments =
        [judgment("low", &[9.0, 9.2], 10.5), diverged, judgment("high", &[13.0, 14.0], 10.5)];
    // Of the deviations 0.71 and 0.14 the root mean square is 0.51, twice that 1.02.
    let (order, can_rank, verdict) = ranked(&judgments);
    assert_eq!((order, can_rank), (["high", "low", "diverged"].map(str::to_owned).to_vec(), true));
    assert!(verdict.contains("less than 1.02") && verdict.contains("0.50 off"), "{verdict}");
    let text =
        Ranking::of(judgments.to_vec())[0].parts().map(|part| part.render(Style::Text)).concat();
    assert!(text.contains("a ranking, not a score") && text.contains("13.50 ± 0.71"), "{text}");
    assert!(!text.contains("500000006") && text.contains("beyond what rewards allow"), "{text}");
}

#[test]
fn what_the_behavior_s_estimate_misses_by_more_is_not_ranked() {
    let (_, can_rank, verdict) =
        ranked(&[judgment("a", &[9.0], 14.0), judgment("b", &[12.0], 14.0)]);
    assert!(!can_rank && verdict.contains("4.00 off") && verdict.contains("3.00"), "{verdict}");
    assert!(ranked(&[judgment("a", &[8.0, 10.0], 10.0), judgment("b", &[12.0, 14.0], 10.0)]).1);
    let (_, can_rank, verdict) =
        ranked(&[judgment("a", &[8.0, 12.0], 10.0), judgment("b", &[12.0, 14.0], 10.0)]);
    assert!(
        !can_rank && verdict.contains("no more than 3.00"),
        "the seeds differ as much: {verdict}"
    );
    let mut doubtful = judgment("a", &[9.0], 10.0);
    doubtful.behavior.doubts.push("it moves".to_owned());
    assert!(!ranked(&[doubtful.clone(), doubtful]).1);
    assert!(!ranked(&[judgment("alone", &[9.0], 10.0)]).1);
}

#[test]
fn judgments_of_other_conditions_are_apart() {
    let mut others = [judgment("other", &[1.0], 10.0), judgment("other", &[1.0], 10.0)];
    others[0].conditions.gamma = 0.9;
    others[1].conditions.environment = "another arm".to_owned();
    for other in others {
        assert_eq!(
            Ranking::of([judgment("a", &[1.0], 10.0), other, judgment("b", &[2.0], 10.0)]).len(),
            2
        );
    }
}

#[test]
fn a_judgment_takes_the_place_of_an_earlier_one_of_its_step() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    for (step, value) in [(40, 1.0), (20, 2.0), (40, 3.0)] {
        Judgment { step, ..judgment("run", &[value], 10.0) }.keep(&run).unwrap();
    }
    let kept = Judgment::read_all(&run).unwrap();
    assert_eq!(
        Vec::from_iter(kept.iter().map(|one| (one.step, one.estimate.values[0]))),
        [(20, 2.0), (40, 3.0)]
    );
}

#[test]
fn judges_at_work_at_a_time_lose_no_judgment() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    std::thread::scope(|scope| {
        for judge in 0..4 {
            let run = &run;
            scope.spawn(move || {
                for step in 0..5 {
                    let mut one = judgment("a", &[1.0], 10.0);
                    one.step = 5 * judge + step;
                    one.keep(run).unwrap();
                }
            });
        }
    });
    let kept = Judgment::read_all(&run).unwrap();
    assert_eq!(Vec::from_iter(kept.iter().map(|one| one.step)), Vec::from_iter(0..20));
}

#[test]
fn judgments_that_do_not_say_of_which_environment_they_are_do_not_count() {
    let folder = tempfile::tempdir().unwrap();
    let run = RunDir::at(folder.path());
    let mut written = serde_json::to_value([judgment("a", &[1.0], 10.0)]).unwrap();
    written[0]["conditions"].as_object_mut().unwrap().remove("environment");
    run.write_json(FILE, &written).unwrap();
    assert_eq!(Judgment::read_all(&run).unwrap(), []);
}
