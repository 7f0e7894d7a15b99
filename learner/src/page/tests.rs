//! Tests of the web server's answers, and of what it reads.

use std::fs;
use std::path::Path;
use std::time::Duration;

use quad_run::folder::RunDir;
use quad_runtime::{Health, serve_metrics};
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

use super::reader::RunPage;
use super::*;
use crate::fixtures::{config, line};

/// Head and body of each answer.
async fn get(root: &Path, paths: &[&str]) -> Vec<(String, String)> {
    let pages = routes(root.to_owned(), None);
    let any_port = ([127, 0, 0, 1], 0).into();
    let server = serve_metrics(any_port, &[], Default::default(), Health::default(), pages).await;
    let server = server.unwrap();
    let mut answers = Vec::new();
    for path in paths {
        let mut connection = TcpStream::connect(server.address).await.unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        connection.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        let read = connection.read_to_string(&mut answer);
        let read = timeout(Duration::from_secs(60), read).await;
        read.unwrap().unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        answers.push((head.to_owned(), body.to_owned()));
    }
    answers
}

#[tokio::test]
async fn the_page_needs_no_other_host_and_has_no_inline_script() {
    let folder = tempfile::tempdir().unwrap();
    let paths = ["/", "/page.js", "/charts.js", "/dygraph.js", "/page.css"];
    let answers = get(folder.path(), &paths).await;
    let (head, page) = &answers[0];
    assert!(head.contains("default-src 'none'; script-src 'self'"), "{head}");
    assert!(!head.contains("unsafe"), "{head}");
    for inline in ["://", "<script>", "style="] {
        assert!(!page.contains(inline), "{page}");
    }
    for (head, text) in &answers {
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        assert!(text.len() > 500, "{text}");
    }
    for writes_html in ["innerHTML", "insertAdjacent", "document.write"] {
        let scripts = &mut answers[1..3].iter();
        assert!(scripts.all(|(_, text)| !text.contains(writes_html)));
    }
    assert!(answers.iter().map(|(_, text)| text.len()).sum::<usize>() < 200_000);
}

#[tokio::test]
async fn the_api_has_runs_with_scores_metrics_and_settings() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a", "b/c"] {
        let dir = folder.path().join(name);
        let (_, mut scores) = RunDir::create(&dir, &config("run", 1)).unwrap();
        let lines = [line(2000, 1, 10.0), line(2000, 2, 12.0), line(4000, 1, 5.0)];
        scores.append(&lines).unwrap();
        let metrics = "{\"step\":100,\"seconds\":1.0,\"bc_loss\":0.5}\n";
        fs::write(dir.join("metrics.jsonl"), metrics).unwrap();
    }
    let missing = ["/api/run/nonsense", "/api/run/..%2Fb%2Fc", "/api/live"];
    let paths = [&["/api/runs", "/api/run/b%2Fc"][..], &missing].concat();
    let answers = get(folder.path(), &paths).await;
    for (head, _) in &answers[2..] {
        assert!(head.starts_with("HTTP/1.1 404"), "{answers:?}");
    }
    let [list, run] = [0, 1].map(|index| serde_json::from_str::<Value>(&answers[index].1).unwrap());
    let names = list.as_array().unwrap().iter().map(|run| &run["name"]);
    assert_eq!(Vec::from_iter(names), ["a", "b/c"]);
    assert_eq!(run["run"], "b/c");
    let whole = json!([2000, 11.0, 2f64.sqrt(), 2, true]);
    let part = json!([4000, 5.0, null, 1, false]);
    assert_eq!(run["evaluations"], json!([whole, part]));
    let history = json!({ "names": ["bc_loss"], "rows": [[100.0, 1.0, 0.5]] });
    assert_eq!(run["history"], history);
    let metrics = config("run", 1).experiment.definition().unwrap().metrics;
    assert_eq!(run["metrics"].as_array().unwrap().len(), metrics.len());
    let settings = run["settings"].as_str().unwrap();
    assert!(settings.contains("[experiment.agent]"));
}

#[test]
fn a_new_run_in_the_same_folder_is_shown_alone() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    let mut page = RunPage::new(&dir);
    for (started, steps) in [(1, 3), (2, 4)] {
        let mut config = config("run", started);
        config.run.started = started;
        RunDir::create(&dir, &config).unwrap();
        let line = |n| format!("{{\"step\":{n},\"seconds\":{n}.0,\"bc_loss\":{started}.0}}\n");
        fs::write(dir.join("metrics.jsonl"), String::from_iter((1..=steps).map(line))).unwrap();
        let shown = page.read().unwrap();
        let rows = shown["history"]["rows"].as_array().unwrap();
        assert_eq!(rows.len(), steps);
        assert!(rows.iter().all(|row| row[2] == started as f64), "{rows:?}");
        RunDir::at(&dir).set_aside().unwrap();
    }
}

#[test]
fn names_that_no_metric_has_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("run");
    RunDir::create(&dir, &config("run", 0)).unwrap();
    let line = |step| format!("{{\"step\":{step},\"name{step}\":1.0,\"held_out_bc_loss\":2.0}}\n");
    fs::write(dir.join("metrics.jsonl"), String::from_iter((1..=40_000).map(line))).unwrap();
    let shown = RunPage::new(&dir).read().unwrap();
    assert_eq!(shown["history"]["names"], json!(["held_out_bc_loss"]));
}
