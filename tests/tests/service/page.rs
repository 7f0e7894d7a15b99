//! The page in a browser: Debian's Chromium, without a screen.

use std::process::Command;

use quad_tests::peers::has;
use quad_tests::process::{Process, built, stdout};
use quad_tests::prometheus::training_metrics;
use quad_tests::setting::{ENDLESS, SHORT};
use quad_tests::system::Scratch;

/// The page as the browser has it after some seconds of its own clock.
fn shown(address: &str) -> String {
    let flags = "--headless=new --no-sandbox --disable-gpu --virtual-time-budget=8000 --dump-dom";
    let mut chromium = Command::new("chromium");
    stdout(&chromium.args(flags.split(' ')).arg(address).output().unwrap())
}

/// Asserts that a page has all of some words, between bars.
fn assert_has(page: &str, words: &str) {
    for words in words.split('|') {
        assert!(page.contains(words), "{words} is missing in\n{page}");
    }
}

#[test]
fn a_browser_shows_a_run_at_work() {
    if !has("chromium", "--version") {
        return;
    }
    let scratch = Scratch::new();
    let flags = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "2"];
    let learner = scratch.learner_with("run", ENDLESS, &flags);
    learner.wait_for_scores(4 * ENDLESS.episodes as usize);
    learner.wait_for_metric("evaluators", "", |there| there == 2.0);
    let page = shown(&format!("http://{}/", learner.metrics()));
    let words = "<title>run</title>|all is well|evaluator-1|evaluator-2|steps per second|Last episodes|episodes = 6|\
                 aria-label=\"critic_loss, newest values: critic_loss |\
                 aria-label=\"lambda_fifth, newest values: 1 ";
    assert_has(&page, words);
    // A chart of each metric that Grafana's dashboard has, too, with its newest value for those who
    // do not see it.
    let metrics = training_metrics();
    assert!(metrics.len() > 10, "{metrics:?}");
    for name in metrics {
        assert_has(&page, &format!("aria-label=\"{name}, newest values: "));
    }
    assert!(!page.contains("e+15</td>"), "seeds have every digit: {page}");
}

#[test]
fn a_browser_compares_finished_runs() {
    if !has("chromium", "--version") {
        return;
    }
    let scratch = Scratch::new();
    for name in ["one", "other"] {
        let flags = ["--listen", "tcp/127.0.0.1:0", "--evaluators", "1"];
        scratch.learner_with(&format!("runs/{name}"), SHORT, &flags).assert_completes();
    }
    // A folder's name is shown as text.
    let runs = scratch.path().join("runs");
    std::fs::rename(runs.join("other"), runs.join("<img src=x onerror=alert(1)>")).unwrap();
    let mut command = Command::new(built("learner"));
    command.args(["page", "--http", "127.0.0.1:0"]).arg(runs);
    let server = Process::start("page", scratch.path(), command);
    let line = server.wait_for_log("page: http://");
    let (_, address) = line.split_once("page: ").unwrap();
    let address = address.split_whitespace().next().unwrap();
    let ticks = "#%5B%22one%22%2C%22%3Cimg%20src%3Dx%20onerror%3Dalert(1)%3E%22%5D";
    let ticked = shown(&format!("{address}{ticks}"));
    let words = "<title>2 runs</title>|&lt;img src=x onerror=alert(1)&gt;|\
                 aria-label=\"Score, newest values: one |, &lt;img src=x onerror=alert(1)&gt; |\
                 aria-label=\"critic_loss, newest values: one ";
    assert_has(&ticked, words);
    assert!(!ticked.contains("<img"), "{ticked}");
    // An address may end in what names no run.
    for end in ["", "#top", "#5", "#%"] {
        let none = shown(&format!("{address}{end}"));
        assert_has(&none, "Tick runs|<title>2 runs");
        assert!(!none.contains("newest values"), "{none}");
    }
}
