//! Several runs behind one router, one evaluator for all of them.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use quad_protocol::{Name, keys};
use quad_service::{Endpoints, open_session};
use quad_tests::crowd::{Crowd, Pace};
use quad_tests::router::{configuration, router, router_without_scores};
use quad_tests::system::{Scratch, Setting, free_port};
use quad_tests::{PATIENCE, eventually, http};
use zenoh::bytes::ZBytes;
use zenoh::key_expr::KeyExpr;
use zenoh::query::Query;

#[tokio::test(flavor = "multi_thread")]
async fn one_evaluator_serves_two_runs_in_turn_and_survives_the_routers_restart() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let endless = Setting { steps: 100_000_000, eval_interval: 500, ..Setting::default() };
    let _evaluator = scratch.evaluator("shared", &endpoint);
    let first = scratch.learner_with("first", endless, &["--connect", &endpoint]);
    let second = scratch.learner_with("second", endless, &["--connect", &endpoint]);
    let both_scored = |count: usize| {
        eventually("both runs have new scores", PATIENCE, || {
            (first.scores().len() > count && second.scores().len() > count).then_some(())
        });
    };

    let session = router(&endpoint).await;
    both_scored(0);
    session.close().await.unwrap();
    drop(session);
    let before = first.scores().len().max(second.scores().len());
    let _session = router(&endpoint).await;
    both_scored(before + 2 * endless.episodes as usize);
}

#[test]
fn one_evaluator_serves_two_learners_that_listen_themselves() {
    let scratch = Scratch::new();
    let setting = Setting::default();
    let mut first = scratch.learner("first", setting);
    let mut second = scratch.learner("second", setting);
    let (one, two) = (first.endpoint(), second.endpoint());
    let _evaluator = scratch.evaluator_with("shared", &["--connect", &one, "--connect", &two]);
    for learner in [&mut first, &mut second] {
        let status = learner.process.wait(PATIENCE);
        assert!(status.success(), "the learner ended with {status}");
        learner.assert_complete(&setting);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_measured_while_cut_off_are_delivered_later() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let setting = Setting { steps: 10, eval_interval: 10, episodes: 20, candidates: 1000, hidden: 256, seed: 1 };
    let session = router_without_scores(&endpoint, None).await;
    let mut learner = scratch.learner_with("run", setting, &["--connect", &endpoint]);
    let evaluator = scratch.evaluator("cut-off", &endpoint);
    evaluator.process.wait_for_log("evaluating", PATIENCE);
    session.close().await.unwrap();
    drop(session);
    // It finds out that nobody answers when it has the scores.
    evaluator.process.wait_for_log("nobody answered quad/run/scores", PATIENCE);
    assert!(learner.scores().is_empty());

    let _session = router(&endpoint).await;
    let status = learner.process.wait(PATIENCE);
    assert!(status.success(), "the learner ended with {status}");
    learner.assert_complete(&setting);
    let page = http::metrics(&evaluator.metrics()).unwrap();
    let measured = http::sum(&page, "quad_evaluator_episodes_total", "");
    assert_eq!(measured, f64::from(setting.episodes), "nothing was measured twice");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flood_ends_at_the_router_and_an_evaluator_of_many_runs_is_none() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let idle = Setting { steps: 100_000_000, eval_interval: 50_000_000, ..Setting::default() };
    let learners = ["a", "b", "c"].map(|run| scratch.learner_with(run, idle, &["--connect", &endpoint]));
    let evaluator = scratch.evaluator("shared", &endpoint);
    for learner in &learners {
        eventually("the evaluator is there", PATIENCE, || {
            let page = http::metrics(&learner.metrics())?;
            (http::sum(&page, "quad_learner_evaluators", "") == 1.0).then_some(())
        });
    }
    // It asks each of them ten times a second or more, and would complain after five seconds without an answer.
    let honest = tokio::time::sleep(Duration::from_secs(7));

    let flood = async {
        let endpoints = Endpoints { connect: vec![endpoint.clone()], ..Endpoints::default() };
        let stranger = open_session(&endpoints).await.unwrap();
        let keys = ["jobs", "scores", "weights/1", "progress/e"].map(|key| format!("quad/flooded/{key}"));
        let arrived = [0; 4].map(|_| Arc::new(AtomicUsize::new(0)));
        let counting = |count: &Arc<AtomicUsize>| {
            let count = count.clone();
            move || {
                count.fetch_add(1, Relaxed);
            }
        };
        let mut queryables = Vec::new();
        for (key, count) in keys.iter().zip(&arrived).take(3) {
            let count = counting(count);
            queryables.push(session.declare_queryable(key).callback(move |_| count()).await.unwrap());
        }
        let count = counting(&arrived[3]);
        let _progress = session.declare_subscriber(&keys[3]).callback(move |_| count()).await.unwrap();
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(2) {
            for key in &keys[..3] {
                stranger.get(key).timeout(Duration::from_secs(1)).callback(drop).await.unwrap();
            }
            stranger.put(&keys[3], "words").await.unwrap();
            stranger.delete(&keys[3]).await.unwrap();
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
        for ((key, count), per_second) in keys.iter().zip(&arrived).zip([25.0, 25.0, 5.0, 25.0]) {
            let most = (begin.elapsed().as_secs_f64() * per_second) as usize + 1;
            let count = count.load(Relaxed);
            assert!((1..=most).contains(&count), "{count} messages at {key} were passed on");
        }
    };
    tokio::join!(honest, flood);
    assert!(!evaluator.process.log().contains("nobody answered"), "{}", evaluator.process.log());

    for section in ["downsampling", "low_pass_filter"] {
        let [plain, protected] =
            ["router.json5", "router-tls.json5"].map(|file| configuration(file).get_json(section).unwrap());
        assert_eq!(plain, protected, "both routers drop the same: {section}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_too_large_ends_at_the_router() {
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    let stranger = open_session(&Endpoints { connect: vec![endpoint], ..Endpoints::default() }).await.unwrap();
    let (sender, arrived) = mpsc::channel();
    let questioned = sender.clone();
    let told = move |key: &KeyExpr, size| sender.send((key.to_string(), size)).unwrap();
    let subscriber = session.declare_subscriber("quad/run/**");
    let _subscriber = subscriber.callback(move |put| told(put.key_expr(), put.payload().len())).await.unwrap();
    let asked = move |query: Query| {
        let size = query.payload().map_or(0, ZBytes::len);
        questioned.send((query.key_expr().to_string(), size)).unwrap();
    };
    let _queryable = session.declare_queryable("quad/run/**").callback(asked).await.unwrap();

    let puts = [("progress/e", 1 << 12), ("scores/1", 1 << 20)];
    let questions = [("weights/1", 1 << 12), ("jobs", 30 << 10), ("scores", 30 << 10)];
    for (number, (key, largest)) in puts.into_iter().chain(questions).enumerate() {
        let key = format!("quad/run/{key}");
        // Slowly enough for the limits on how many there may be.
        for size in [largest, largest + 1, largest] {
            tokio::time::sleep(Duration::from_millis(250)).await;
            match number < puts.len() {
                true => stranger.put(&key, vec![0; size]).await.unwrap(),
                false => stranger.get(&key).payload(vec![0; size]).callback(drop).await.unwrap(),
            }
        }
        let next = || arrived.recv_timeout(PATIENCE).unwrap();
        assert_eq!([next(), next()], [(key.clone(), largest), (key, largest)]);
    }
    stranger.put("quad/run/progress/e", vec![0; 60 << 20]).await.unwrap();
    assert_eq!(arrived.recv_timeout(Duration::from_secs(3)).ok(), None, "60 MB of progress");
}

#[tokio::test(flavor = "multi_thread")]
async fn evaluators_behind_a_router_are_seen_once_they_ask_and_missed_when_they_leave() {
    let scratch = Scratch::new();
    let endpoint = format!("tcp/127.0.0.1:{}", free_port());
    let session = router(&endpoint).await;
    // Jobs of seconds, so that somebody leaves in the middle of one.
    let endless = Setting { steps: 100_000_000, eval_interval: 500, episodes: 400, ..Setting::default() };
    let learner = scratch.learner_with("run", endless, &["--connect", &endpoint]);
    learner.process.wait_for_log("snapshot handed to evaluation", PATIENCE);
    let metric = |name: &str, label: &str| Some(http::sum(&http::metrics(&learner.metrics())?, name, label));
    let lost_jobs = || metric("quad_learner_jobs_total", "expired").unwrap();
    let present = |count: f64, patience| {
        let what = format!("{count} evaluators are there");
        eventually(&what, patience, || (metric("quad_learner_evaluators", "")? == count).then_some(()));
    };

    // Whoever has only a token is nobody.
    let (run, mut strangers) = (Name::new("run").unwrap(), Vec::new());
    for number in 0..50 {
        let key = keys::live_evaluator(&run, &Name::new(format!("stranger-{number}")).unwrap());
        strangers.push(session.liveliness().declare_token(key).await.unwrap());
    }
    for _ in 0..2 {
        let lost = lost_jobs();
        let crowd = Crowd::connect(3, &run, &endpoint).await;
        crowd.set(Pace::Real);
        present(3.0, PATIENCE);
        eventually("all have jobs", PATIENCE, || (crowd.busy() == 3).then_some(()));
        // Their leases would last longer.
        drop(crowd);
        present(0.0, Duration::from_secs(5));
        // Perhaps not three: somebody may have been done just then.
        eventually("their jobs are given up", Duration::from_secs(5), || (lost_jobs() > lost).then_some(()));
    }
}
