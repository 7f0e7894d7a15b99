//! Tests of `page/mod.rs`: what a browser is answered.

use std::time::Duration;

use quad_run::run::RunDir;
use quad_runtime::{Health, serve_metrics};
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use super::*;
use crate::fixtures::{config, line};

/// Runs in folders below one.
fn runs(folder: &std::path::Path, names: &[&str]) {
    for name in names {
        let (_, mut scores) = RunDir::create(&folder.join(name), &config("run", 1)).unwrap();
        scores.append(&[line(2000, 1, 10.0), line(2000, 2, 12.0), line(4000, 1, 5.0)]).unwrap();
        let metrics = "{\"step\":100,\"seconds\":1.0,\"bc_loss\":0.5}\n";
        std::fs::write(folder.join(name).join("metrics.jsonl"), metrics).unwrap();
    }
}

/// The status line and headers, and the body, of an answer.
async fn get(root: &std::path::Path, live: Option<Live>, paths: &[&str]) -> Vec<(String, String)> {
    let pages = routes(root.to_owned(), live).unwrap();
    let any_port = ([127, 0, 0, 1], 0).into();
    let server =
        serve_metrics(any_port, Default::default(), Health::default(), pages).await.unwrap();
    let mut answers = Vec::new();
    for path in paths {
        let mut connection = TcpStream::connect(server.address).await.unwrap();
        connection
            .write_all(format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes())
            .await
            .unwrap();
        let mut answer = String::new();
        tokio::time::timeout(Duration::from_secs(60), connection.read_to_string(&mut answer))
            .await
            .unwrap()
            .unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        answers.push((head.to_owned(), body.to_owned()));
    }
    answers
}

#[tokio::test]
async fn the_page_needs_no_other_host_and_runs_no_script_of_its_own() {
    let folder = tempfile::tempdir().unwrap();
    let answers =
        get(folder.path(), None, &["/", "/page.js", "/charts.js", "/dygraph.js", "/page.css"])
            .await;
    let [(head, page), files @ ..] = &answers[..] else { panic!() };
    assert!(
        head.contains("script-src 'self'")
            && head.contains("default-src 'none'")
            && !head.contains("unsafe"),
        "{head}"
    );
    assert!(
        !page.contains("://") && !page.contains("<script>") && !page.contains("style="),
        "{page}"
    );
    assert!(files.iter().all(|(head, text)| head.starts_with("HTTP/1.1 200") && text.len() > 500));
    // Of our own scripts, none writes HTML.
    let writes_html = |text: &str| {
        ["innerHTML", "insertAdjacent", "document.write"].iter().any(|way| text.contains(way))
    };
    assert!(files[..2].iter().all(|(_, text)| !writes_html(text)));
    // A whole load of the page, but for the answers.
    assert!(answers.iter().map(|(_, text)| text.len()).sum::<usize>() < 200_000);
}

#[tokio::test]
async fn runs_are_listed_and_each_tells_its_scores_metrics_and_settings() {
    let folder = tempfile::tempdir().unwrap();
    runs(folder.path(), &["a", "b/c"]);
    let answers = get(
        folder.path(),
        None,
        &["/api/runs", "/api/run/b%2Fc", "/api/run/nonsense", "/api/run/..%2Fb%2Fc", "/api/live"],
    )
    .await;
    let json = |index: usize| serde_json::from_str::<Value>(&answers[index].1).unwrap();
    let names: Vec<_> = json(0).as_array().unwrap().iter().map(|run| run["name"].clone()).collect();
    assert_eq!(names, ["a", "b/c"]);
    let run = json(1);
    assert_eq!(
        run["evaluations"],
        serde_json::json!([[2000, 11.0, 2f64.sqrt(), 2, true], [4000, 5.0, null, 1, false]])
    );
    assert_eq!(
        (&run["history"]["names"][0], &run["history"]["rows"][0][2]),
        (&"bc_loss".into(), &0.5.into())
    );
    assert_eq!(
        run["metrics"].as_array().unwrap().len(),
        config("run", 1).experiment.definition().unwrap().metrics.len()
    );
    assert!(run["settings"].as_str().unwrap().contains("[experiment.agent]"));
    assert!(answers[2..].iter().all(|(head, _)| head.starts_with("HTTP/1.1 404")), "{answers:?}");
}

#[tokio::test]
async fn a_learner_says_what_it_does_at_the_moment() {
    let folder = tempfile::tempdir().unwrap();
    let live: Live = Arc::new(|| serde_json::json!({ "step": 7 }));
    let answers = get(folder.path(), Some(live), &["/api/live"]).await;
    assert_eq!(answers[0].1, "{\"step\":7}");
}
