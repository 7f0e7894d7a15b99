//! The page in a browser: Debian's Chromium, without a screen.

use std::process::Command;

use quad_tests::peers::has_chromium;
use quad_tests::process::{Process, binary};
use quad_tests::setting::{ENDLESS, SHORT};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, dashboard};

/// The page as the browser has it after some seconds of its own clock.
fn shown(address: &str) -> String {
    let flags = [
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--virtual-time-budget=8000",
        "--dump-dom",
    ];
    let output = Command::new("chromium").args(flags).arg(address).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn assert_has(page: &str, words: &[&str]) {
    words.iter().for_each(|words| assert!(page.contains(words), "{words} is missing in\n{page}"));
}

#[test]
fn a_browser_shows_a_run_at_work() {
    if !has_chromium() {
        return;
    }
    let scratch = Scratch::new();
    let flags = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "2"];
    let learner = scratch.learner_with("run", ENDLESS, &flags);
    learner.wait_for_scores(4 * ENDLESS.episodes as usize);
    learner.wait_for_metric("evaluators", "", |there| there == 2.0);
    let page = shown(&format!("http://{}/", learner.metrics()));
    assert_has(
        &page,
        &["<title>run</title>", "all is well", "evaluator-1", "evaluator-2", "steps per second"],
    );
    // A chart of each metric that Grafana's dashboard has, too, with its newest value for those who
    // do not see it.
    let metrics = dashboard::metrics();
    assert!(metrics.len() > 10, "{metrics:?}");
    metrics
        .iter()
        .for_each(|name| assert_has(&page, &[&format!("aria-label=\"{name}, newest values: ")]));
    assert_has(
        &page,
        &[
            "aria-label=\"critic_loss, newest values: critic_loss ",
            "aria-label=\"lambda_fifth, newest values: 1 ",
        ],
    );
    assert_has(&page, &["Last episodes", "episodes = 6"]);
    assert!(!page.contains("e+15</td>"), "seeds have every digit: {page}");
}

#[test]
fn a_browser_compares_finished_runs() {
    if !has_chromium() {
        return;
    }
    let scratch = Scratch::new();
    for name in ["one", "other"] {
        let flags = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "1"];
        scratch.learner_with(&format!("runs/{name}"), SHORT, &flags).assert_completes(PATIENCE);
    }
    // A folder's name is shown as text.
    let runs = scratch.path().join("runs");
    std::fs::rename(runs.join("other"), runs.join("<img src=x onerror=alert(1)>")).unwrap();
    let mut command = Command::new(binary("learner"));
    command.args(["page", "--http", "127.0.0.1:0"]).arg(runs);
    let mut server = Process::start("page", scratch.path(), command);
    let line = server.wait_for_log("page: http://", PATIENCE);
    let address = line.split_whitespace().find(|word| word.starts_with("http://")).unwrap();
    let ticked = shown(&format!(
        "{address}#%5B%22one%22%2C%22%3Cimg%20src%3Dx%20onerror%3Dalert(1)%3E%22%5D"
    ));
    assert_has(
        &ticked,
        &[
            "<title>2 runs</title>",
            "&lt;img src=x onerror=alert(1)&gt;",
            "aria-label=\"Score, newest values: one ",
            ", &lt;img src=x onerror=alert(1)&gt; ",
        ],
    );
    assert!(!ticked.contains("<img"), "{ticked}");
    assert_has(&ticked, &["aria-label=\"critic_loss, newest values: one "]);
    // An address may end in what names no run.
    for end in ["", "#top", "#5", "#%"] {
        let none = shown(&format!("{address}{end}"));
        assert!(
            none.contains("Tick runs")
                && none.contains("<title>2 runs")
                && !none.contains("newest values"),
            "{none}"
        );
    }
    server.terminate(PATIENCE);
}
