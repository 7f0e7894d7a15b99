//! `--audit`: what one evaluator says is checked by another, and a lie is found out.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::fs;
use std::time::Duration;

use quad_dataset::environment;
use quad_policy::Precision;
use quad_protocol::{
    EpisodeScore, Job, JobReply, JobRequest, Message, Progress, ScoreReply, ScoreReport, decode, encode, keys,
};
use quad_tests::made_up::{self, name};
use quad_tests::router::router;
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use serde_json::Value;
use zenoh::{Session, Wait};

async fn ask<A: Message>(session: &Session, key: String, question: Vec<u8>) -> A {
    loop {
        let replies = session.get(&key).payload(question.clone()).timeout(Duration::from_secs(5)).await.unwrap();
        if let Ok(reply) = replies.recv_async().await
            && let Ok(sample) = reply.into_result()
        {
            return decode(&sample.payload().to_bytes()).unwrap();
        }
    }
}

/// A job for the liar; it is another one if `attempt` is.
async fn claim(session: &Session, attempt: u64) -> Job {
    let claim = encode(&made_up::claim("liar", attempt, "hopper")).unwrap();
    loop {
        match ask(session, keys::jobs(&name("run")), claim.clone()).await {
            JobReply::Job(job) => return job,
            _ => tokio::time::sleep(Duration::from_millis(50)).await,
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_that_were_made_up_are_found_out_by_the_next_evaluator() {
    let scratch = Scratch::new();
    let setting = Setting { episodes: 4, ..Setting::default() };
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let mut learner = scratch.learner_with("run", setting, &["--connect", &endpoint, "--audit", "1"]);

    // A job done by nobody: its scores are possible, but not true.
    let run = name("run");
    let job = claim(&session, 1).await;
    let hopper = environment::find("hopper").unwrap();
    let score =
        |&seed: &u64| EpisodeScore { seed, episode_return: 5.0, length: 10, score: hopper.normalised_score(5.0) };
    let report =
        ScoreReport::of(&job, name("liar"), name(&Precision::F32.arithmetic()), job.seeds.iter().map(score).collect());
    let reply: ScoreReply = ask(&session, keys::scores(&run), encode(&report).unwrap()).await;
    assert!(matches!(reply, ScoreReply::Recorded { new: 4, .. }), "{reply:?}");

    // Of another one nothing is delivered, so that the run goes on until both are there: without, nobody checks the last scores.
    let held = claim(&session, 2).await;
    let _honest: Vec<_> = ["honest", "true"]
        .map(|name| scratch.evaluator_with(name, &["--connect", &endpoint, "--precision", "f32"]))
        .into();
    let mut steps_done = 0;
    let page = eventually("both are there and the lie is found out", PATIENCE, || {
        steps_done += 1;
        let progress = Progress { steps_done, ..Progress::of(&held, name("liar")) }.signed(&held.lease);
        session.put(keys::progress(&run, &name("liar")), encode(&progress).unwrap()).wait().unwrap();
        let page = http::metrics(&learner.metrics())?;
        let found_out = http::sum(&page, "quad_learner_audits_total", "outcome=\"differ\"") == 4.0;
        (found_out && http::sum(&page, "quad_learner_evaluators", "") == 2.0).then_some(page)
    });
    let hand_back = JobRequest::HandBack { evaluator: name("liar"), job: held.id, lease: held.lease, failed: None };
    let reply: JobReply = ask(&session, keys::jobs(&run), encode(&hand_back).unwrap()).await;
    assert!(matches!(reply, JobReply::HandedBack { accepted: true, .. }), "{reply:?}");
    assert!(http::sum(&page, "quad_learner_scores_duplicate_total", "") >= 4.0);
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
    assert!(learner.process.log().contains("evaluators liar and "), "{}", learner.process.log());

    let lines = fs::read_to_string(learner.run_dir.join("audits.jsonl")).unwrap();
    let lines: Vec<Value> = lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    for line in &lines {
        let lied = line["evaluators"][0] == "liar";
        assert_eq!((line["agree"] == false, line["step"] == job.step), (lied, lied), "{line}");
        assert_ne!(line["evaluators"][0], line["evaluators"][1], "{line}");
    }
    assert_eq!(lines.len(), 4 * setting.evaluated_steps().len(), "honest scores are checked, too, up to the last");
}
