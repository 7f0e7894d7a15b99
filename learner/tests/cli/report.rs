//! Figures and pages of `learner report`. Its texts and numbers are in report.trycmd,
//! published.trycmd and study.trycmd.

use std::fs;
use std::path::Path;

use crate::printed;
use crate::run::{Run, online, small, write_all, write_study};

fn draw(folder: &Path) {
    printed(&format!("report {0} --figures {0}/figures", folder.display()));
}

/// Draws the figures of runs; gives the curve of their task.
fn curve(runs: &[Run]) -> String {
    let folder = tempfile::tempdir().unwrap();
    write_all(folder.path(), runs.iter().cloned());
    draw(folder.path());
    fs::read_to_string(folder.path().join("figures/curve-hopper-demo.svg")).unwrap()
}

#[test]
fn a_study_has_a_figure_of_each_kind() {
    let folder = tempfile::tempdir().unwrap();
    write_study(folder.path().to_str().unwrap());
    draw(folder.path());
    for (name, labels) in [
        ("profile", &["iql"][..]),
        ("curve-hopper-demo", &["iql"]),
        ("curve-walker2d-demo", &["iql"]),
        // The axis of τ names whole powers of ten.
        ("tau", &["τ", "\n0.1\n", "\n1\n", "\n10\n"]),
    ] {
        let file = folder.path().join("figures").join(name);
        let png = fs::read(file.with_extension("png")).unwrap();
        assert!(png.starts_with(b"\x89PNG\r\n\x1a\n") && png.len() > 10_000, "{name}");
        let svg = fs::read_to_string(file.with_extension("svg")).unwrap();
        assert!(svg.starts_with("<svg"), "{svg}");
        for part in [&["<polygon", "quad"], labels].concat() {
            assert!(svg.contains(part), "{part} is missing in {svg}");
        }
    }
}

#[test]
fn curves_show_complete_evaluations_only() {
    let runs = [small(0, 0.0), small(1, 1.0)];
    let mut without_part = runs.clone();
    for run in &mut without_part {
        run.scores.pop();
    }
    assert_eq!(curve(&runs), curve(&without_part));

    let [mut complete, mut stopped] = runs;
    complete.score(6000, 0, 12.0, "00");
    stopped.scores.truncate(4);
    assert!(curve(&[complete, stopped]).contains("quad (1 seed, not complete)"));

    let begins = |runs: &[Run]| curve(runs).contains("\n online\n");
    assert!(begins(&[online()]) && begins(&[small(1, 0.0), online()]));
    assert!(!begins(&[small(0, 0.0)]));

    let robot = small(0, 0.0).set("experiment.environment", "my-robot");
    assert!(!curve(&[robot.clone().scores_are_returns()]).contains("normalized"));
    // A score that evaluators define is none of the data's.
    let has_mean = |run: Run| curve(&[run]).contains("dataset mean");
    assert!(has_mean(robot.clone().scores_are_returns()) && !has_mean(robot));
}

#[test]
fn a_page_is_one_file_and_escapes_what_it_shows() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let dataset = "<script>alert(1)</script>.hdf5";
    small(3, 0.0).set("experiment.dataset", dataset).write(path("a"));
    small(4, 1.0).write(path("b"));
    small(5, 1.0).write(path("damaged"));
    fs::write(path("a/film.gif"), "GIF89a of a run").unwrap();
    let [page, b] = ["page.html", "b"].map(|name| path(name).display().to_string());
    printed(&format!("report {} {b} --html {page}", path("a").display()));
    let text = fs::read_to_string(&page).unwrap().replace("&#x2f;", "/");
    assert!(!text.contains("<script") && text.contains("&lt;script&gt;alert(1)"), "{text}");
    // Nothing is fetched: neither scripts nor pictures have addresses.
    assert!(["href=\"http", "src=\"/", "url("].iter().all(|words| !text.contains(words)), "{text}");
    for words in [
        "<svg",
        "2 runs, 0 complete",
        "src=\"data:image/gif;base64,R0lGODlhIG9mIGEgcnVu\"",
        &format!("--seed 4 --run-dir {b}"),
        "8.50 ± 0.71 (0.50)",
        "steps = 6000",
        "100 transitions of 3 episodes",
    ] {
        assert!(text.contains(words), "{words} is missing in\n{text}");
    }

    fs::write(path("damaged/scores.jsonl"), "{\"step\":10}\n").unwrap();
    crate::learner(&format!("report {} --html {page}", folder.path().display()));
    let text = fs::read_to_string(&page).unwrap().replace("&#x2f;", "/");
    assert!(text.contains("damaged/scores.jsonl, line 1, is not what a learner writes"), "{text}");
}
