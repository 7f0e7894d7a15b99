//! Tests of published scores.

use super::*;

fn paper() -> &'static Tables {
    &SOURCES[0]
}

/// The columns of Tables 1 and 2 add up to the totals that the paper gives; quad.toml names the
/// three that do not.
#[test]
fn columns_add_up_to_the_totals_of_the_paper() {
    let total = |method: &str, figure: usize, maze: bool| {
        let tasks = paper().scores.iter().filter(|(task, _)| task.starts_with("antmaze") == maze);
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
        let totals = [false, true].map(|maze| total(method, 0, maze));
        assert_eq!(totals, [locomotion, antmaze], "{method}");
    }
    let replication = |figure, maze| total("DAC-Rep", figure, maze);
    let table_2 = [0, 1].map(|figure| replication(figure, false) + replication(figure, true));
    assert_eq!(table_2.map(|total| (total * 10.0).round() / 10.0), [511.8, 58.1]);
}

/// CORL's README has these averages of ReBRAC and TD3+BC.
#[test]
fn columns_have_the_averages_of_corl() {
    let [corl, mazes] = [&SOURCES[1], &SOURCES[2]];
    for (source, method, average) in [
        (corl, "TD3+BC", 76.45),
        (corl, "ReBRAC", 89.74),
        (mazes, "TD3+BC", 19.33),
        (mazes, "IQL", 57.17),
        (mazes, "ReBRAC", 78.42),
    ] {
        let scores = source.scores.values().map(|scores| scores[method][0]);
        let mean = scores.sum::<f64>() / source.scores.len() as f64;
        assert!((mean - average).abs() < 0.01, "{method}: {mean}");
    }
}

#[test]
fn every_score_has_a_method() {
    for source in &*SOURCES {
        for (task, scores) in &source.scores {
            let has_row = |name: &String| source.method.iter().any(|method| method.name == *name);
            assert!(scores.keys().all(has_row), "{task}");
        }
    }
    for task in paper().scores.keys() {
        let published = scores(task);
        assert!(published[0].method == "QUAD" && published[0].score.std.is_some(), "{task}");
    }
}

#[test]
fn tables_of_a_run() {
    let paper = &["Table 1 of the paper", "Table 2 of the paper"][..];
    let (mazes, ogbench) = (&["D4RL's mazes of version 2"], &["OGBench's default tasks"]);
    for (task, algorithm, expected) in [
        ("hopper-medium-replay-v2", "quad", paper),
        ("hopper-medium-v2", "quad", &paper[..1]),
        ("hopper-medium-replay-v2", "iql", &paper[..1]),
        ("hopper-medium-v2", "td3-bc", &["Locomotion by CORL"]),
        // Without a row of its own, in the first table of the task.
        ("hopper-medium-v2", "idql", &paper[..1]),
        ("antmaze-umaze-v2", "fql", mazes),
        ("antmaze-umaze-v2", "quad", mazes),
        ("cube-single-play-singletask-v0", "fql", ogbench),
        ("cube-single-play-singletask-v0", "quad", ogbench),
        ("hopper-demo", "quad", &[]),
    ] {
        assert_eq!(tables(task, algorithm), expected, "{task}, {algorithm}");
    }
}

#[test]
fn every_remark_is_on_a_score_and_differs_from_it() {
    for source in &*SOURCES {
        for remark in &source.remark {
            for method in &remark.methods {
                let score = |task: &String| source.scores.get(task)?.get(method)?.first();
                let is_on =
                    |task: &String| score(task).and_then(|_| remark.on(method, task)).is_some();
                assert!(source.scores.keys().any(is_on), "{method}: {}", remark.reason);
                for (task, instead) in &remark.instead {
                    assert!(score(task).is_some_and(|score| score != instead), "{method}, {task}");
                }
            }
        }
    }
}

#[test]
fn final_evaluations_of_a_score() {
    for (task, evaluations) in [
        ("hopper-medium-v2", 5),
        ("hopper-demo", 5),
        ("antmaze-umaze-v2", 3),
        ("antmaze-large-navigate-singletask-v0", 3),
        ("cube-single-play-singletask-v0", 3),
        ("pointmaze-medium-stitch-singletask-task2-v0", 3),
    ] {
        assert_eq!(final_evaluations(task), evaluations, "{task}");
    }
}
