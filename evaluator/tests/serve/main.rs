//! The promises of `evaluator serve` to a learner: the scores that it delivers, until they are
//! saved, and its leave. The learner is a fake (`learner`), the evaluator and Zenoh are real.
#![allow(clippy::unwrap_used)]

mod learner;
mod online;

use quad_evaluator::sim::{EnvironmentError, Environments, Rollout, Simulations};
use quad_policy::{Precision, load_policy};
use quad_protocol::{EpisodeScore, Job, ScoreReport, encode, keys};
use zenoh::qos::CongestionControl;

use learner::{Behavior, Event, Learner, file, in_order, job, name};

/// The scores that `job` must have, to the last bit.
fn expected(job: &Job) -> Vec<EpisodeScore> {
    let policy = load_policy(&file(), Precision::F32).unwrap();
    let make = || Simulations.make(&job.environment, job.environment_seed);
    let mut rollout = Rollout::new(make, (11, 3), &job.seeds, |seed| policy.begin(seed)).unwrap();
    while !rollout.is_done() {
        let stepped = rollout.step(|observations, states, actions| {
            policy.act(observations, states, actions).unwrap();
            Ok::<_, EnvironmentError>(())
        });
        stepped.unwrap();
    }
    rollout.into_scores()
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_are_of_exactly_the_weights_and_seeds_that_the_job_names() {
    for published in [false, true] {
        let learner = Learner::start(file(), Behavior::Records).await;
        let job = job(&learner.snapshot);
        let (evaluator, _token) = learner.evaluator().await;
        let _dead = learner.announce_dead().await;
        // At first the evaluator may follow the dead learner, which was started first.
        learner.wait_for(|events| (events.len() >= 4).then_some(())).await;
        if published {
            // Sent before the job, and not to be dropped.
            let weights = encode(&learner.snapshot).unwrap();
            let put = learner.session.put(keys::weights(&name("run")), weights);
            put.congestion_control(CongestionControl::Block).await.unwrap();
        }
        learner.give(job.clone());
        let precision = name(&Precision::F32.arithmetic());
        let expected = ScoreReport::new(&job, name("one"), precision, expected(&job));
        assert_eq!(learner.wait_for_scores(1).await, expected);
        let requests = learner.count(|event| *event == Event::Weights);
        assert_eq!(requests, usize::from(!published));
        drop(evaluator);
        assert_eq!(learner.count(Event::is_handed_back), 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaving_evaluator_hands_its_job_back_unless_its_scores_may_be_saved() {
    in_order(async || {
        let (learner, evaluator, _token) = Learner::with_job(file(), Behavior::DiskFull).await;
        learner.wait_for_scores(1).await;
        let in_order = evaluator.leave();
        assert_eq!(learner.count(Event::is_handed_back), 0);
        in_order
    })
    .await;
    for behavior in [Behavior::Silent, Behavior::Hangs] {
        in_order(async || {
            let (learner, evaluator, _token) = Learner::with_job(file(), behavior).await;
            learner.wait_for_scores(1).await;
            if !evaluator.leave() {
                return false;
            }
            // On a busy machine it arrives only after the evaluator has gone.
            learner.behave(Behavior::Silent);
            assert_eq!(learner.wait_for_hand_back().await, None);
            true
        })
        .await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_fails_is_handed_back_with_the_reason() {
    let learner = Learner::start(b"no tensors".to_vec(), Behavior::Records).await;
    let (_evaluator, _token) = learner.evaluator().await;
    let good = job(&learner.snapshot);
    let (mut unknown, mut empty) = (good.clone(), good.clone());
    unknown.environment = "moon".to_owned();
    empty.seeds.clear();
    for (job, reason) in [(unknown, "moon"), (empty, "0 episodes"), (good, "safetensors")] {
        learner.give(job);
        let has_reason =
            |event: &Event| matches!(event, Event::HandedBack(Some(text)) if text.contains(reason));
        learner.wait_for(|events| events.iter().any(has_reason).then_some(())).await;
    }
}

/// Otherwise the learner would wait for it until the lease ends.
#[tokio::test(flavor = "multi_thread")]
async fn a_job_whose_scores_are_refused_is_handed_back() {
    let (learner, _evaluator, _token) = Learner::with_job(file(), Behavior::Refuses).await;
    let reason = learner.wait_for_hand_back().await;
    assert_eq!(reason.unwrap(), "it refused the scores: the sums differ");
    // They are not sent again.
    assert_eq!(learner.count(Event::is_scores), 1);
}
