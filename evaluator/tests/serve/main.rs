//! The promises of `evaluator serve` to a learner: the scores that it delivers, until they are
//! saved, and its leave. The learner is a fake (`learner`), the evaluator and Zenoh are real.
#![allow(clippy::unwrap_used)]

mod learner;
mod online;

use quad_evaluator::sim::{EnvironmentError, Environments, Rollout, Simulations};
use quad_policy::{Precision, load_policy};
use quad_protocol::{EpisodeScore, Job, ScoreReport, encode, keys};
use zenoh::qos::CongestionControl;

use learner::{Behavior, Event, Learner, file, job, name, reports};

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
        assert!(evaluator.leave().success());
        assert_eq!(learner.count(Event::is_handed_back), 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_claim_without_an_answer_is_repeated() {
    let learner = Learner::start(file(), Behavior::IgnoresClaims).await;
    let (_evaluator, _token) = learner.evaluator().await;
    let claims = |events: &[Event]| -> Vec<u64> {
        let number = |event: &Event| match event {
            Event::Claim(number) => Some(*number),
            _ => None,
        };
        events.iter().filter_map(number).collect()
    };
    let three = |events: &[Event]| Some(claims(events)).filter(|claims| claims.len() >= 3);
    let first = learner.wait_for(three).await;
    let is_other = |number: &u64| *number != first[0];
    assert!(!first.iter().any(is_other), "{first:?}");
    learner.behave(Behavior::Records);
    learner.wait_for(|events| claims(events).into_iter().find(is_other)).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_are_sent_until_the_learner_has_saved_them() {
    let (learner, _evaluator, _token) = Learner::with_job(file(), Behavior::DiskFull).await;
    let report = learner.wait_for_scores(3).await;
    learner.behave(Behavior::Records);
    let claims = |events: &[Event]| matches!(events.last(), Some(Event::Claim(_))).then_some(());
    learner.wait_for(claims).await;
    let events = learner.events();
    assert!(reports(&events).len() > 3 && reports(&events).iter().all(|again| *again == report));
    let first = events.iter().position(Event::is_scores).unwrap();
    let last = events.iter().rposition(Event::is_scores).unwrap();
    let deliveries = &events[first..last];
    // Nothing is claimed meanwhile.
    assert!(deliveries.iter().all(Event::is_scores), "{events:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_leaving_evaluator_hands_its_job_back_unless_its_scores_may_be_saved() {
    for (behavior, hands_back) in [(Behavior::DiskFull, false), (Behavior::Silent, true)] {
        let (learner, evaluator, _token) = Learner::with_job(file(), behavior).await;
        learner.wait_for_scores(1).await;
        assert!(evaluator.leave().success());
        if hands_back {
            // On a busy machine it arrives only after the evaluator has gone.
            learner.wait_for_hand_back().await;
        }
        let returned = learner.count(Event::is_handed_back);
        assert_eq!(returned, usize::from(hands_back));
        assert!(learner.count(Event::is_scores) > 1, "they are sent again");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_leaves_in_time_though_its_learner_hangs() {
    let (learner, evaluator, _token) = Learner::with_job(file(), Behavior::Hangs).await;
    learner.wait_for_scores(1).await;
    assert!(evaluator.leave().success());
    // The learner has not answered the scores, so it finds the job handed back.
    learner.behave(Behavior::Silent);
    assert_eq!(learner.wait_for_hand_back().await, None);
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

#[tokio::test(flavor = "multi_thread")]
async fn scores_that_come_too_early_are_delivered_again_and_hold_up_no_job() {
    let (learner, _evaluator, _token) = Learner::with_job(file(), Behavior::IsEarlier).await;
    let again = learner.wait_for_scores(2).await;
    assert_eq!(reports(&learner.events())[0], again);
    // They go before a job of the same evaluation, but not before others.
    learner.give(Job { id: 3, ..job(&learner.snapshot) });
    assert_eq!(learner.wait_for_hand_back().await, None);
    learner.give(Job { id: 2, step: 20, seeds: vec![21], ..job(&learner.snapshot) });
    let has = |events: &[Event], step| reports(events).iter().any(|report| report.step == step);
    learner.wait_for(|events| has(events, 20).then_some(())).await;
    let before = learner.events().len();
    learner.behave(Behavior::Records);
    let both = |events: &[Event]| [10, 20].iter().all(|step| has(&events[before..], *step));
    learner.wait_for(|events| both(events).then_some(())).await;
    assert_eq!(learner.count(Event::is_handed_back), 1);
    assert!(reports(&learner.events()).iter().all(|report| report.job != 3));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_is_handed_back_until_the_learner_answers_and_nothing_is_claimed_before() {
    let learner = Learner::start(b"no tensors".to_vec(), Behavior::LosesHandBack).await;
    let (_evaluator, _token) = learner.evaluator().await;
    learner.give(job(&learner.snapshot));
    let claims_again = |events: &[Event]| {
        let first = events.iter().position(Event::is_handed_back)?;
        matches!(events.last()?, Event::Claim(_)).then_some(first)
    };
    let first = learner.wait_for(claims_again).await;
    let events = learner.events();
    let last = events.iter().rposition(Event::is_handed_back).unwrap();
    assert!(first < last, "it is handed back twice: {events:?}");
    let is_claim = |event: &Event| matches!(event, Event::Claim(_));
    assert!(!events[first..last].iter().any(is_claim), "{events:?}");
}
