//! What `evaluator serve` promises a learner: which scores it delivers, what it does until they are
//! saved, and how it leaves. The learner is made up (`learner`); the evaluator is the program, and
//! Zenoh is real.
#![allow(clippy::unwrap_used)]

mod learner;

use quad_evaluator::sim::{EnvironmentError, Environments, Rollout, Simulations};
use quad_policy::{Precision, load_policy};
use quad_protocol::{EpisodeScore, Job, ScoreReport, encode, keys};
use zenoh::qos::CongestionControl;

use learner::{Answer, Heard, Learner, file, handed_back, job, name, reports, snapshot};

/// The scores that `job` must have, to the last bit.
fn expected(job: &Job, file: &[u8]) -> Vec<EpisodeScore> {
    let policy = load_policy(file, Precision::F32).unwrap();
    let make = || Simulations.make(&job.environment, job.environment_seed);
    let mut rollout = Rollout::new(make, (11, 3), &job.seeds, |seed| policy.begin(seed)).unwrap();
    while !rollout.is_done() {
        rollout
            .step(|observations, states, actions| {
                policy.act(observations, states, actions).unwrap();
                Ok::<_, EnvironmentError>(())
            })
            .unwrap();
    }
    let outcomes = rollout.into_outcomes().into_iter();
    outcomes
        .map(|outcome| EpisodeScore {
            seed: outcome.seed,
            episode_return: outcome.episode_return,
            length: outcome.length,
            score: outcome.score,
        })
        .collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_are_of_exactly_the_weights_and_seeds_that_the_job_names() {
    for published in [false, true] {
        let learner = Learner::start(snapshot(file(2))).await;
        let job = job(&learner.snapshot);
        let (evaluator, _tokens) = learner.evaluator().await;
        // At first the evaluator may follow the learner that is dead, which was started first.
        learner.wait_for(|heard| (heard.len() >= 4).then_some(())).await;
        if published {
            // Not to be dropped, and on its way before the job is.
            let put = learner
                .session
                .put(keys::weights(&name("run")), encode(&learner.snapshot).unwrap());
            put.congestion_control(CongestionControl::Block).await.unwrap();
        }
        learner.give(job.clone());
        let report = learner.wait_for_scores(1).await;
        let precision = name(&Precision::F32.arithmetic());
        assert_eq!(
            report,
            ScoreReport::of(&job, name("one"), precision, expected(&job, &learner.snapshot.file))
        );
        assert_eq!(learner.count(|heard| *heard == Heard::Weights), usize::from(!published));
        assert!(evaluator.leave().success());
        assert_eq!(learner.count(|heard| matches!(heard, Heard::HandedBack(_))), 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_claim_without_an_answer_is_the_same_claim_again() {
    let learner = Learner::start(snapshot(file(2))).await;
    learner.answer(Answer::NoClaim);
    let (_evaluator, _token) = learner.only_evaluator().await;
    let claims = |heard: &[Heard]| -> Vec<u64> {
        heard
            .iter()
            .filter_map(|heard| if let Heard::Claim(number) = heard { Some(*number) } else { None })
            .collect()
    };
    let first =
        learner.wait_for(|heard| Some(claims(heard)).filter(|claims| claims.len() >= 3)).await;
    assert!(first.iter().all(|number| *number == first[0]), "{first:?}");
    learner.answer(Answer::Recorded);
    learner
        .wait_for(|heard| claims(heard).iter().any(|number| *number != first[0]).then_some(()))
        .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn scores_are_sent_again_until_the_learner_has_saved_them() {
    let learner = Learner::start(snapshot(file(2))).await;
    learner.answer(Answer::DiskFull);
    learner.give(job(&learner.snapshot));
    let (_evaluator, _tokens) = learner.evaluator().await;
    let report = learner.wait_for_scores(3).await;
    learner.answer(Answer::Recorded);
    learner.wait_for(|heard| matches!(heard.last(), Some(Heard::Claim(_))).then_some(())).await;
    let heard = learner.heard.lock().unwrap();
    assert!(reports(&heard).len() > 3 && reports(&heard).iter().all(|again| *again == report));
    let is_score = |heard: &Heard| matches!(heard, Heard::Scores(_));
    let (first, last) =
        (heard.iter().position(is_score).unwrap(), heard.iter().rposition(is_score).unwrap());
    assert!(heard[first..last].iter().all(is_score), "nothing new is claimed meanwhile: {heard:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_that_leaves_hands_its_job_back_unless_its_scores_may_be_saved() {
    for (answer, goes_back) in [(Answer::DiskFull, false), (Answer::Nothing, true)] {
        let learner = Learner::start(snapshot(file(2))).await;
        learner.answer(answer);
        learner.give(job(&learner.snapshot));
        let (evaluator, _tokens) = learner.evaluator().await;
        learner.wait_for_scores(1).await;
        assert!(evaluator.leave().success());
        if goes_back {
            // On a busy machine it is heard only after the evaluator has gone.
            learner.wait_for(handed_back).await;
        }
        assert_eq!(
            learner.count(|heard| matches!(heard, Heard::HandedBack(_))),
            usize::from(goes_back)
        );
        assert!(
            learner.count(|heard| matches!(heard, Heard::Scores(_))) > 1,
            "they are sent again"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluator_leaves_in_time_though_its_learner_hangs() {
    let learner = Learner::start(snapshot(file(2))).await;
    learner.answer(Answer::Hang);
    learner.give(job(&learner.snapshot));
    let (evaluator, _tokens) = learner.evaluator().await;
    learner.wait_for_scores(1).await;
    assert!(evaluator.leave().success());
    // A learner that hangs has said nothing of the scores. When it goes on, it finds that the job
    // is handed back.
    learner.answer(Answer::Nothing);
    assert_eq!(learner.wait_for(handed_back).await, None);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_fails_is_handed_back_with_the_reason() {
    let learner = Learner::start(snapshot(b"no tensors".to_vec())).await;
    let (_evaluator, _tokens) = learner.evaluator().await;
    let good = job(&learner.snapshot);
    for (job, reason) in [
        (Job { environment: "moon".to_owned(), ..good.clone() }, "moon"),
        (Job { seeds: Vec::new(), ..good.clone() }, "0 episodes"),
        (good, "safetensors"),
    ] {
        learner.give(job);
        let told = |heard: &[Heard]| {
            heard
                .iter()
                .any(
                    |heard| matches!(heard, Heard::HandedBack(Some(text)) if text.contains(reason)),
                )
                .then_some(())
        };
        learner.wait_for(told).await;
    }
}

/// The learner would else believe for the whole lease that the evaluator is at it.
#[tokio::test(flavor = "multi_thread")]
async fn a_job_whose_scores_are_refused_is_handed_back() {
    let learner = Learner::start(snapshot(file(2))).await;
    learner.answer(Answer::Refused);
    learner.give(job(&learner.snapshot));
    let (_evaluator, _tokens) = learner.evaluator().await;
    let reason = learner.wait_for(handed_back).await;
    assert_eq!(reason, Some("it refused the scores: they are of another sum".to_owned()));
    assert_eq!(
        learner.count(|heard| matches!(heard, Heard::Scores(_))),
        1,
        "they are not sent again"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_is_handed_back_until_the_learner_answers_and_nothing_is_claimed_before() {
    let learner = Learner::start(snapshot(b"no tensors".to_vec())).await;
    learner.answer(Answer::LostHandBack);
    let (_evaluator, _token) = learner.only_evaluator().await;
    learner.give(job(&learner.snapshot));
    learner
        .wait_for(|heard| {
            (handed_back(heard).is_some() && matches!(heard.last(), Some(Heard::Claim(_))))
                .then_some(())
        })
        .await;
    let heard = learner.heard.lock().unwrap();
    let is_back = |heard: &Heard| matches!(heard, Heard::HandedBack(_));
    let (first, last) =
        (heard.iter().position(is_back).unwrap(), heard.iter().rposition(is_back).unwrap());
    assert!(first < last, "it is handed back once more: {heard:?}");
    assert!(!heard[first..last].iter().any(|heard| matches!(heard, Heard::Claim(_))), "{heard:?}");
}
