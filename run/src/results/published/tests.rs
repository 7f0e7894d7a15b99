//! Tests of `report/published.rs`.

use super::*;

/// The columns of Tables 1 and 2 add up to the totals that the paper gives; published.toml names the three that do not.
#[test]
fn columns_add_up_to_the_totals_of_the_paper() {
    let total = |method: &str, figure: usize, maze: bool| {
        let tasks = TABLES.scores.iter().filter(|(preset, _)| preset.starts_with("antmaze") == maze);
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
        assert_eq!([total(method, 0, false), total(method, 0, true)], [locomotion, antmaze], "{method}");
    }
    let table_2 = [0, 1].map(|figure| total("DAC-Rep", figure, false) + total("DAC-Rep", figure, true));
    assert_eq!(table_2.map(|total| (total * 10.0).round() / 10.0), [511.8, 58.1]);
}

#[test]
fn every_score_has_a_method_and_the_papers_own_has_a_deviation() {
    for (preset, methods) in &TABLES.scores {
        let published = scores(preset);
        assert_eq!(published.len(), methods.len(), "{preset}");
        assert!(published[0].method == "QUAD" && published[0].score.std.is_some(), "{preset}");
    }
}

#[test]
fn every_remark_is_on_a_figure_and_says_something_else_than_it() {
    for known in &TABLES.remark {
        for method in &known.methods {
            let figures = TABLES.scores.iter().filter(|(_, scores)| scores.contains_key(method));
            assert!(figures.clone().any(|(task, _)| known.on(method, task).is_some()), "{method}: {}", known.reason);
            for (task, instead) in &known.instead {
                let printed = TABLES.scores.get(task).and_then(|scores| scores.get(method)?.first());
                assert!(printed.is_some_and(|printed| printed != instead), "{method}, {task}: {instead}");
            }
        }
    }
}
