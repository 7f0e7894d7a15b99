//! Episodes that are scored a second time.

use quad_learner::resume::{Earlier, Unchecked};
use quad_learner::scoreboard::{Audited, Claim, Screened};
use quad_protocol::JobReply;

use crate::bench::{Bench, hash};
use crate::common::{full_report, name, report, score};

#[test]
fn an_audited_episode_is_scored_again_by_another_evaluator_of_the_same_precision_and_counts_once() {
    let mut bench = Bench::with_audit(1.0);
    let first = bench.job("a", 0);
    let (_, recorded) = bench.deliver(&full_report(&first, "a")).unwrap();
    assert_eq!((recorded.jobs_completed, recorded.audited.len()), (1, 0));

    // Not by itself; what it delivers again is no second opinion.
    assert!(bench.deliver(&full_report(&first, "a")).unwrap().1.audited.is_empty());
    assert_eq!(bench.job("a", 1).seeds, [6, 7]);
    // Not in another arithmetic.
    let environments = ["hopper".to_owned()];
    let (evaluator, precision) = (name("c"), name("bf16"));
    let claim =
        Claim { evaluator: &evaluator, attempt: 1, environments: &environments, precision: &precision, present: 0 };
    let JobReply::Job(other) = bench.board.claim(claim, bench.at(1)) else { panic!("there is work") };
    assert_eq!(other.step, 2000);

    // By another one, before all that waits; whoever is lost with it loses nothing.
    let again = bench.job("b", 2);
    assert_eq!((again.step, again.seeds.clone(), again.weights), (1000, first.seeds.clone(), first.weights));
    assert_eq!(bench.gone("b", 2).given_up, []);
    let again = bench.job("d", 3);
    assert_eq!(again.seeds, first.seeds);
    let mut report = full_report(&again, "d");
    let changed = report.episodes[2].seed;
    report.episodes[2] = score(changed, 500.0f64.next_up());
    let (screened, recorded) = bench.deliver(&report).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates, recorded.jobs_completed), (0, 5, 1));
    let differ: Vec<_> = recorded.audited.iter().filter(|audited| !audited.agree()).collect();
    assert_eq!((recorded.audited.len(), differ.len()), (5, 1));
    assert_eq!((differ[0].first.0.seed, &differ[0].first.1, &differ[0].second.1), (changed, &name("a"), &name("d")));
    assert!(matches!(bench.board.screen(&report), Ok(Screened { duplicates: 5, .. })), "nothing was changed by it");
}

#[test]
fn what_an_earlier_life_has_not_audited_is_audited() {
    let mut bench = Bench::with_audit(1.0);
    let episodes = vec![score(21, 400.0), score(22, 500.0)];
    let unchecked = Unchecked { score: episodes[1], evaluator: name("a"), precision: name("f32") };
    let earlier = Earlier { weights: hash(500).to_string(), episodes, unchecked: vec![unchecked] };
    bench.board.remember([(500, earlier)].into());
    bench.board.add_evaluation(500, hash(500), &[21, 22]).unwrap();
    assert_eq!(bench.board.audits(), [1, 0]);
    assert_eq!(bench.job("a", 0).step, 1000, "not by whoever scored it first");
    let job = bench.job("b", 0);
    assert_eq!((job.step, &job.seeds, bench.board.audits()), (500, &vec![22], [0, 1]));
    let report = report(&job, "b", vec![score(22, 500.0)]);
    assert!(bench.deliver(&report).unwrap().1.audited.iter().all(Audited::agree));
    assert_eq!(bench.board.audits(), [0, 0]);
}
