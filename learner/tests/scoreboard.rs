//! The scoreboard under a clock of the test's own.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::{Duration, Instant};

use quad_learner::resume::Earlier;
use quad_learner::scoreboard::{Claim, Lost, Recorded, Refusal, Rules, Scoreboard, Screened};
use quad_protocol::{CannotAct, EpisodeScore, Hash, Job, JobReply, Lease, Name, Progress, ScoreReport};

const LEASE: Duration = Duration::from_secs(10);
const INCARNATION: u64 = 77;

struct Bench {
    board: Scoreboard,
    start: Instant,
}

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn hash(step: u64) -> Hash {
    Hash::of(&step.to_le_bytes())
}

fn score(seed: u64, episode_return: f64) -> EpisodeScore {
    let hopper = quad_dataset::environment::find("hopper").unwrap();
    EpisodeScore { seed, episode_return, length: 100, score: hopper.normalised_score(episode_return) }
}

fn report(job: &Job, evaluator: &str, episodes: Vec<EpisodeScore>) -> ScoreReport {
    let Job { run, incarnation, step, weights, .. } = job.clone();
    ScoreReport {
        evaluator: name(evaluator),
        run,
        incarnation,
        job: job.id,
        step,
        weights,
        precision: name("f32"),
        episodes,
        cannot_act: None,
    }
}

fn full_report(job: &Job, evaluator: &str) -> ScoreReport {
    report(job, evaluator, job.seeds.iter().map(|&seed| score(seed, 500.0)).collect())
}

/// Of so many environment steps, with its proof.
fn progress(job: &Job, evaluator: &str, steps_done: u64) -> Progress {
    Progress {
        evaluator: name(evaluator),
        run: job.run.clone(),
        incarnation: job.incarnation,
        job: job.id,
        step: job.step,
        episodes_done: 0,
        episodes_total: 5,
        steps_done,
        environment_steps: 10,
        episodes: 1,
        proof: Hash::of(b"none"),
    }
    .signed(&job.lease)
}

impl Bench {
    /// Evaluations of steps 1000 and 2000, seven episodes each: seeds 1..=7 and 11..=17.
    fn new() -> Self {
        Self::with_audit(0.0)
    }

    fn with_audit(audit: f64) -> Self {
        let rules = Rules {
            run: name("run"),
            incarnation: INCARNATION,
            task: quad_dataset::environment::find("hopper").unwrap().into(),
            instance: 5,
            candidates: 10,
            job_episodes: 5,
            lease: LEASE,
            audit,
        };
        let mut board = Scoreboard::new(rules);
        board.add_evaluation(2000, hash(2000), &Vec::from_iter(11..=17)).unwrap();
        board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
        Self { board, start: Instant::now() }
    }

    fn at(&self, seconds: u64) -> Instant {
        self.start + Duration::from_secs(seconds)
    }

    fn claim(&mut self, evaluator: &str, attempt: u64, seconds: u64) -> JobReply {
        let now = self.at(seconds);
        let environments = ["ant".to_owned(), "hopper".to_owned()];
        self.board.claim(
            Claim { evaluator: &name(evaluator), attempt, environments: &environments, precision: &name("f32"), present: 0 },
            now,
        )
    }

    fn job(&mut self, evaluator: &str, seconds: u64) -> Job {
        // Another attempt at another time.
        match self.claim(evaluator, seconds, seconds) {
            JobReply::Job(job) => job,
            other => panic!("{other:?} at {seconds} s"),
        }
    }

    fn progress(&mut self, progress: &Progress, seconds: u64) -> Result<(), Refusal> {
        let now = self.at(seconds);
        self.board.progress(progress, now)
    }

    fn expire(&mut self, seconds: u64) -> usize {
        let now = self.at(seconds);
        self.board.expire(now).jobs
    }

    /// As the hub does: screen, then record.
    fn deliver(&mut self, report: &ScoreReport) -> Result<(Screened, Recorded), Refusal> {
        let screened = self.board.screen(report)?;
        let recorded = self.board.record(report, &screened.new);
        Ok((screened, recorded))
    }
}

#[test]
fn jobs_go_out_oldest_step_first_and_no_episode_twice() {
    let mut bench = Bench::new();
    let jobs = ["a", "b", "c", "d"].map(|evaluator| bench.job(evaluator, 0));
    let handed_out: Vec<_> = jobs.iter().map(|job| (job.step, job.seeds.clone())).collect();
    let expected =
        [(1000, vec![1, 2, 3, 4, 5]), (1000, vec![6, 7]), (2000, vec![11, 12, 13, 14, 15]), (2000, vec![16, 17])];
    assert_eq!(handed_out, expected);
    assert_eq!((jobs[0].weights, jobs[2].weights), (hash(1000), hash(2000)));
    assert_eq!((jobs[0].incarnation, jobs[0].candidates, jobs[0].lease_milliseconds), (INCARNATION, 10, 10_000));
    assert!(jobs[1..].iter().all(|job| job.lease != jobs[0].lease), "each lease is another");
    assert!(matches!(bench.claim("e", 0, 0), JobReply::Wait { milliseconds: 1.., incarnation: INCARNATION }));
    assert_eq!((bench.board.pending(), bench.board.handed_out()), (14, 4));
}

#[test]
fn an_evaluator_without_the_environment_gets_nothing() {
    let mut bench = Bench::new();
    for environments in [vec![], vec!["ant".to_owned()]] {
        let now = bench.at(0);
        let claim = Claim { evaluator: &name("a"), attempt: 1, environments: &environments, precision: &name("f32"), present: 0 };
        assert!(matches!(bench.board.claim(claim, now), JobReply::Wait { .. }));
    }
}

#[test]
fn a_claim_that_is_repeated_gets_the_same_job_and_another_one_waits() {
    let mut bench = Bench::new();
    let first = bench.job("a", 0);
    assert_eq!(bench.claim("a", 0, 3), JobReply::Job(first.clone()), "the answer was lost");
    assert!(matches!(bench.claim("a", 1, 3), JobReply::Wait { .. }), "one job at a time");
    assert_eq!((bench.board.handed_out(), bench.job("b", 3).seeds), (1, vec![6, 7]));
    assert_eq!(bench.expire(10), 1, "to ask again does not extend the lease");
    assert_eq!(bench.job("a", 10).seeds, first.seeds);
}

#[test]
fn scores_complete_a_job_and_an_evaluation_once() {
    let mut bench = Bench::new();
    let (first, second) = (bench.job("a", 0), bench.job("b", 0));
    let (screened, recorded) = bench.deliver(&full_report(&first, "a")).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates), (5, 0));
    assert_eq!(recorded, Recorded { jobs_completed: 1, ..Recorded::default() });
    assert_eq!(bench.board.pending(), 9);

    let (_, recorded) = bench.deliver(&full_report(&second, "b")).unwrap();
    let seeds: Vec<_> = recorded.evaluation_completed.unwrap().iter().map(|score| score.seed).collect();
    assert_eq!(seeds, Vec::from_iter(1..=7), "in the order of the evaluation's seeds");
    assert_eq!(bench.job("a", 1).step, 2000, "an evaluator that has delivered gets the next");
}

#[test]
fn a_report_delivered_again_is_accepted_and_counted_once() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.deliver(&full_report(&job, "a")).unwrap();
    let (screened, recorded) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates), (0, 5));
    assert_eq!(recorded, Recorded::default());
    assert_eq!(bench.board.pending(), 9);
}

#[test]
fn the_first_score_of_an_episode_stays() {
    let mut bench = Bench::new();
    let (job, rest) = (bench.job("a", 0), bench.job("b", 0));
    bench.deliver(&full_report(&job, "a")).unwrap();
    let changed = report(&job, "a", vec![score(1, 3000.0)]);
    assert_eq!(bench.deliver(&changed).unwrap().0.duplicates, 1);
    let (_, recorded) = bench.deliver(&full_report(&rest, "b")).unwrap();
    let scores = recorded.evaluation_completed.unwrap();
    assert!(scores.iter().all(|score| score.episode_return == 500.0));
}

#[test]
fn a_job_may_be_delivered_in_parts() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let (_, recorded) = bench.deliver(&report(&job, "a", vec![score(1, 0.0), score(3, 0.0)])).unwrap();
    assert_eq!(recorded.jobs_completed, 0);
    assert_eq!(bench.board.pending(), 12);
    let (screened, recorded) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates, recorded.jobs_completed), (3, 2, 1));
}

/// An older life of the learner handed the job out, or to somebody else, or nobody knows it any more.
#[test]
fn any_lifes_report_is_welcome_if_step_weights_and_seeds_fit() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let earlier = ScoreReport { incarnation: INCARNATION - 1, job: 99, ..report(&job, "b", vec![score(6, 0.0)]) };
    assert_eq!(bench.deliver(&earlier).unwrap().0.new.len(), 1, "an episode that waits");
    let other = ScoreReport { job: 77, ..full_report(&job, "c") };
    let (screened, recorded) = bench.deliver(&other).unwrap();
    assert_eq!((screened.new.len(), recorded.jobs_completed), (5, 1), "episodes that a has");
    let (screened, _) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates), (0, 5));
    assert_eq!(bench.job("a", 1).seeds, [7]);
}

#[test]
fn a_lease_that_runs_out_gives_the_unscored_episodes_to_the_next() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.deliver(&report(&lost, "a", vec![score(2, 0.0)])).unwrap();
    assert_eq!([bench.expire(9), bench.expire(10), bench.expire(10)], [0, 1, 0], "in time, and only once");
    let next = bench.job("b", 10);
    assert_eq!((next.step, next.seeds), (1000, vec![1, 3, 4, 5, 6]));
    assert_ne!(next.id, lost.id);
}

#[test]
fn progress_extends_the_lease_of_its_job_only() {
    let mut bench = Bench::new();
    let (alive, lost) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in [5, 14, 23] {
        bench.progress(&progress(&alive, "a", seconds), seconds).unwrap();
    }
    assert_eq!(bench.expire(24), 1);
    let next = bench.job("c", 24);
    assert_eq!(next.seeds, lost.seeds);
    assert_eq!(bench.expire(33), 1, "10 s after the last progress");
}

#[test]
fn progress_that_does_not_advance_extends_nothing() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let first = progress(&job, "a", 100);
    bench.progress(&first, 5).unwrap();
    assert_eq!(bench.progress(&first, 9), Err(Refusal::NotAdvanced), "played again");
    assert_eq!(bench.progress(&progress(&job, "a", 99), 9), Err(Refusal::NotAdvanced));
    assert_eq!(bench.progress(&progress(&job, "a", 0), 9), Err(Refusal::NotAdvanced), "it has begun");
    let ended = Progress { episodes_done: 1, ..progress(&job, "a", 100) }.signed(&job.lease);
    bench.progress(&ended, 14).unwrap();
    assert_eq!((bench.expire(23), bench.expire(24)), (0, 1));
}

/// While it fetches the weights an evaluator has nothing to show. It has a minute for that, then it must begin.
#[test]
fn an_evaluator_may_prepare_for_a_while() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in (5..60).step_by(5) {
        bench.progress(&progress(&job, "a", 0), seconds).unwrap();
        bench.progress(&progress(&other, "b", 0), seconds).unwrap();
    }
    bench.progress(&progress(&other, "b", 1), 59).unwrap();
    bench.progress(&progress(&job, "a", 0), 59).unwrap();
    assert_eq!((bench.expire(59), bench.expire(60)), (0, 1), "a's, which has not begun");
    assert_eq!((bench.expire(68), bench.expire(69)), (0, 1));
}

#[test]
fn a_job_has_a_longest_life() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let longest = Job::LONGEST.as_secs();
    for seconds in (5..longest).step_by(5) {
        bench.progress(&progress(&job, "a", seconds), seconds).unwrap();
    }
    assert_eq!((bench.expire(longest - 1), bench.expire(longest)), (0, 1));
}

#[test]
fn progress_of_others_is_refused_and_extends_nothing() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    let good = progress(&job, "a", 10);
    let forged = Progress { proof: Hash::of(b"guessed"), ..good.clone() };
    let changed = Progress { steps_done: 1 << 40, ..good.clone() };
    let by_another_lease = progress(&Job { lease: other.lease.clone(), ..job.clone() }, "a", 10);
    let cases = [
        (forged, Refusal::Proof),
        (changed, Refusal::Proof),
        (by_another_lease, Refusal::Proof),
        (progress(&job, "b", 10), Refusal::Evaluator),
        (progress(&Job { id: 99, ..job.clone() }, "a", 10), Refusal::Job),
        (progress(&Job { run: name("other"), ..job.clone() }, "a", 10), Refusal::Run),
        (progress(&Job { incarnation: 1, ..job.clone() }, "a", 10), Refusal::Incarnation),
    ];
    for (message, refusal) in cases {
        assert_eq!(bench.progress(&message, 9), Err(refusal));
    }
    assert_eq!(bench.expire(10), 2);
}

#[test]
fn progress_does_not_bring_back_a_job_that_was_taken_away() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.expire(10);
    assert_eq!(bench.progress(&progress(&job, "a", 1), 11), Err(Refusal::Job));
    assert_eq!(bench.job("b", 11).seeds, job.seeds);
    assert_eq!(bench.expire(21), 1, "b's alone");
}

#[test]
fn an_evaluator_that_goes_loses_its_job_and_nobody_elses() {
    let mut bench = Bench::new();
    let (first, other) = (bench.job("a", 0), bench.job("b", 0));
    assert_eq!(bench.board.evaluator_gone(&name("a")), Lost { jobs: 1, given_up: vec![] });
    assert_eq!(bench.board.evaluator_gone(&name("a")), Lost::default());
    assert_eq!(bench.job("c", 0).seeds, first.seeds);
    assert_eq!(bench.deliver(&full_report(&other, "b")).unwrap().1.jobs_completed, 1);
}

#[test]
fn only_whoever_has_the_lease_hands_a_job_back() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    assert!(!bench.board.hand_back(&name("a"), job.id, &Lease::random()), "guessed");
    assert!(!bench.board.hand_back(&name("b"), job.id, &job.lease));
    assert!(!bench.board.hand_back(&name("a"), job.id + 1, &job.lease));
    assert_eq!(bench.job("b", 0).seeds, [6, 7]);
    assert!(bench.board.hand_back(&name("a"), job.id, &job.lease));
    assert!(!bench.board.hand_back(&name("a"), job.id, &job.lease), "only once");
    assert_eq!(bench.job("c", 0).seeds, job.seeds);
}

#[test]
fn episodes_that_take_every_evaluator_with_them_are_given_up() {
    let mut bench = Bench::new();
    for _ in 0..100 {
        let job = bench.job("a", 0);
        assert!(bench.board.hand_back(&name("a"), job.id, &job.lease), "this does not count");
    }
    let mut given_up = Vec::new();
    for attempt in 1..=20 {
        assert_eq!((bench.job("a", 0).seeds, given_up.len()), (Vec::from_iter(1..=5), 0), "attempt {attempt}");
        given_up = bench.board.evaluator_gone(&name("a")).given_up;
    }
    let expected = Vec::from_iter((1..=5).map(|seed| (1000, seed)));
    assert_eq!((&given_up, &bench.board.missing()), (&expected, &expected));
    assert_eq!(bench.board.pending(), 9, "the run does not wait for them");
    let next = bench.job("a", 0);
    assert_eq!(next.seeds, [6, 7]);
    let late = report(&next, "b", vec![score(1, 0.0)]);
    assert_eq!(bench.deliver(&late).unwrap().0.new.len(), 1, "but is glad of them");
    assert_eq!(bench.board.missing(), expected[1..]);
}

#[test]
fn whoever_delivers_first_counts_when_a_lost_evaluator_comes_back() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.expire(10);
    let again = bench.job("b", 10);
    let (screened, recorded) = bench.deliver(&full_report(&lost, "a")).unwrap();
    assert_eq!((screened.new.len(), recorded.jobs_completed), (5, 1), "late, but nobody had been faster; b's is over");
    assert!(matches!(bench.job("c", 11).seeds[..], [6, 7]), "nothing of it is handed out again");
    let (screened, recorded) = bench.deliver(&full_report(&again, "b")).unwrap();
    assert_eq!((screened.duplicates, recorded.jobs_completed), (5, 0));
    assert_eq!(bench.board.pending(), 9);
}

#[test]
fn a_report_that_fits_no_evaluation_is_refused() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let good = full_report(&job, "a");
    let with_episode = |episode: EpisodeScore| ScoreReport { episodes: vec![episode], ..good.clone() };
    let twice = ScoreReport { episodes: vec![score(1, 0.0), score(1, 0.0)], ..good.clone() };
    let cases = [
        (ScoreReport { run: name("other"), ..good.clone() }, Refusal::Run),
        (ScoreReport { step: 3000, ..good.clone() }, Refusal::Step),
        (ScoreReport { step: 2000, ..good.clone() }, Refusal::Weights),
        (ScoreReport { weights: hash(2000), ..good.clone() }, Refusal::Weights),
        (with_episode(score(11, 0.0)), Refusal::Seed(11)),
        (twice, Refusal::Seed(1)),
        (with_episode(EpisodeScore { length: 0, ..score(1, 0.0) }), Refusal::Episode(1)),
        (with_episode(EpisodeScore { length: 1001, ..score(1, 0.0) }), Refusal::Episode(1)),
        (with_episode(EpisodeScore { score: 99.0, ..score(1, 0.0) }), Refusal::Episode(1)),
        (with_episode(score(1, f64::NAN)), Refusal::Episode(1)),
        (with_episode(score(1, f64::INFINITY)), Refusal::Episode(1)),
    ];
    for (report, refusal) in cases {
        assert_eq!(bench.board.screen(&report), Err(refusal));
    }
    assert_eq!(bench.board.pending(), 14);
    assert_eq!(bench.deliver(&good).unwrap().0.new.len(), 5);
}

/// Because that ends the run.
#[test]
fn only_whoever_has_the_job_may_say_that_a_policy_cannot_act() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    let signed = |lease: &Lease, weights| CannotAct::signed("NaN".to_owned(), weights, lease);
    let good = ScoreReport { cannot_act: Some(signed(&job.lease, job.weights)), ..report(&job, "a", vec![]) };
    let with = |complaint| ScoreReport { cannot_act: Some(complaint), ..good.clone() };
    let cases = [
        (with(signed(&other.lease, job.weights)), Refusal::Proof),
        (with(signed(&job.lease, hash(2000))), Refusal::Proof),
        (ScoreReport { evaluator: name("b"), ..good.clone() }, Refusal::Evaluator),
        (ScoreReport { job: 99, ..good.clone() }, Refusal::Job),
        (ScoreReport { incarnation: 1, ..good.clone() }, Refusal::Incarnation),
        (ScoreReport { weights: hash(2000), ..good.clone() }, Refusal::Weights),
    ];
    for (report, refusal) in cases {
        assert_eq!(bench.board.screen_complaint(&report), Err(refusal));
    }
    assert_eq!(bench.board.screen_complaint(&good), Ok(()));
}

#[test]
fn an_evaluation_asked_for_twice_is_one() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
    assert_eq!((bench.board.pending(), bench.job("b", 0).seeds), (14, vec![6, 7]));
    assert_eq!(job.seeds.len(), 5);
}

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
    let claim = Claim { evaluator: &evaluator, attempt: 1, environments: &environments, precision: &precision, present: 0 };
    let JobReply::Job(other) = bench.board.claim(claim, bench.at(1)) else { panic!("there is work") };
    assert_eq!(other.step, 2000);

    // By another one, before all that waits; whoever is lost with it loses nothing.
    let again = bench.job("b", 2);
    assert_eq!((again.step, again.seeds.clone(), again.weights), (1000, first.seeds.clone(), first.weights));
    assert_eq!(bench.board.evaluator_gone(&name("b")).given_up, []);
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
fn scores_of_an_earlier_life_count_and_other_weights_are_found_out() {
    let mut bench = Bench::new();
    let earlier = Earlier { weights: hash(3000).to_string(), episodes: vec![score(22, 400.0)] };
    let whole = Earlier { weights: hash(4000).to_string(), episodes: vec![score(32, 1.0), score(31, 2.0)] };
    bench.board.remember([(3000, earlier), (4000, whole)].into());
    let pending = bench.board.pending();
    assert_eq!(bench.board.add_evaluation(3000, hash(3000), &[21, 22, 23]), Ok(None));
    assert_eq!(bench.board.pending(), pending + 2);
    let complete = bench.board.add_evaluation(4000, hash(4000), &[31, 32]).unwrap().unwrap();
    assert_eq!(complete, [score(31, 2.0), score(32, 1.0)]);
    assert_eq!(bench.board.add_evaluation(4000, hash(4000), &[31, 32]), Ok(None), "asked for again");
    let error = bench.board.add_evaluation(3000, hash(1), &[21, 22, 23]).unwrap_err();
    assert_eq!((error.step, error.found, error.scored), (3000, hash(1), hash(3000).to_string()));
}
