//! Tests of `results/published.rs`.

use super::*;

fn paper() -> &'static Tables {
    &SOURCES[0]
}

/// The columns of Tables 1 and 2 add up to the totals that the paper gives; quad.toml names the
/// three that do not.
#[test]
fn columns_add_up_to_the_totals_of_the_paper() {
    let total = |method: &str, figure: usize, maze: bool| {
        let tasks =
            paper().scores.iter().filter(|(preset, _)| preset.starts_with("antmaze") == maze);
        let figures = tasks.filter_map(|(_, scores)| scores.get(method)?.get(figure));
        (figures.sum::<f64>() * 10.0).round() / 10.0
    };
    for (method, locomotion, antmaze) in [
        ("Onestep-RL", 684.6, 125.3),
        ("CQL", 698.5, 303.6),
        ("IQL", 692.6, 378.0),
        ("IVR", 749.7, 432.0),
        ("EQL", 752.9, 420.9),
        ("Diffuser", 678.0, 0.0),
        ("DTQL", 798.3, 453.8),
        ("AlignIQL", 681.1, 462.4),
        ("SfBC", 680.3, 445.4),
        ("DQL", 791.2, 417.8),
        ("DAC", 836.4, 459.9),
        ("QUAD", 842.8, 489.0),
    ] {
        assert_eq!(
            [total(method, 0, false), total(method, 0, true)],
            [locomotion, antmaze],
            "{method}"
        );
    }
    let table_2 =
        [0, 1].map(|figure| total("DAC-Rep", figure, false) + total("DAC-Rep", figure, true));
    assert_eq!(table_2.map(|total| (total * 10.0).round() / 10.0), [511.8, 58.1]);
}

/// CORL's README has these averages of ReBRAC and TD3+BC.
#[test]
fn columns_have_the_averages_that_corl_gives() {
    let [corl, mazes] = [&SOURCES[1], &SOURCES[2]];
    for (source, method, average) in [
        (corl, "TD3+BC", 76.45),
        (corl, "ReBRAC", 89.74),
        (mazes, "TD3+BC", 19.33),
        (mazes, "IQL", 57.17),
        (mazes, "ReBRAC", 78.42),
    ] {
        let sum = source.scores.values().map(|scores| scores[method][0]).sum::<f64>();
        assert!((sum / source.scores.len() as f64 - average).abs() < 0.01, "{method}: {sum}");
    }
}

#[test]
fn every_score_has_a_method_and_the_papers_own_has_a_deviation() {
    for source in &*SOURCES {
        for (task, of_methods) in &source.scores {
            let known = |name: &String| source.method.iter().any(|method| method.name == *name);
            assert!(of_methods.keys().all(known), "{task}");
        }
    }
    for task in paper().scores.keys() {
        let published = scores(task);
        assert!(published[0].method == "QUAD" && published[0].score.std.is_some(), "{task}");
    }
}

#[test]
fn a_run_stands_in_the_tables_that_have_its_algorithm() {
    let paper = ["Table 1 of the paper", "Table 2 of the paper"];
    assert_eq!(tables("hopper-medium-replay-v2", "quad"), paper);
    assert_eq!(tables("hopper-medium-v2", "quad"), paper[..1]);
    assert_eq!(tables("hopper-medium-replay-v2", "iql"), paper[..1]);
    assert_eq!(tables("hopper-medium-v2", "td3-bc"), ["Locomotion by CORL"]);
    assert_eq!(tables("hopper-medium-v2", "idql"), paper[..1], "which has the task");
    for algorithm in ["fql", "quad"] {
        assert_eq!(tables("antmaze-umaze-v2", algorithm), ["D4RL's mazes of version 2"]);
        assert_eq!(
            tables("cube-single-play-singletask-v0", algorithm),
            ["OGBench's default tasks"]
        );
    }
    assert_eq!(tables("hopper-demo", "quad"), [""; 0]);
    assert_eq!(
        ["hopper-medium-v2", "hopper-demo", "cube-single-play-singletask-v0"].map(last),
        [5, 5, 3]
    );
}

#[test]
fn every_remark_is_on_a_figure_and_says_something_else_than_it() {
    for source in &*SOURCES {
        for known in &source.remark {
            for method in &known.methods {
                let figures =
                    source.scores.iter().filter(|(_, scores)| scores.contains_key(method));
                assert!(
                    figures.clone().any(|(task, _)| known.on(method, task).is_some()),
                    "{method}: {}",
                    known.reason
                );
                for (task, instead) in &known.instead {
                    let printed =
                        source.scores.get(task).and_then(|scores| scores.get(method)?.first());
                    assert!(
                        printed.is_some_and(|printed| printed != instead),
                        "{method}, {task}: {instead}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_score_is_of_as_many_evaluations_as_its_benchmarks() {
    for (task, evaluations) in [
        ("hopper-medium-v2", 5),
        ("hopper-demo", 5),
        ("antmaze-umaze-v2", 3),
        ("antmaze-large-navigate-singletask-v0", 3),
        ("pointmaze-medium-stitch-singletask-task2-v0", 3),
    ] {
        assert_eq!(last(task), evaluations, "{task}");
    }
}
