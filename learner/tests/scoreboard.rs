//! The scoreboard under a clock of the test's own.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::time::{Duration, Instant};

use quad_learner::scoreboard::{Recorded, Refusal, Rules, Scoreboard, Screened};
use quad_protocol::{EpisodeScore, Hash, Job, JobReply, JobRequest, Name, Progress, ScoreReport};

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

impl Bench {
    /// Evaluations of steps 1000 and 2000, seven episodes each: seeds 1..=7 and 11..=17.
    fn new() -> Self {
        let rules = Rules {
            run: name("run"),
            incarnation: INCARNATION,
            task: quad_dataset::environment::find("hopper").unwrap().into(),
            instance: 5,
            candidates: 10,
            job_episodes: 5,
            lease: LEASE,
        };
        let mut board = Scoreboard::new(rules);
        board.add_evaluation(2000, hash(2000), &Vec::from_iter(11..=17)).unwrap();
        board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
        Self { board, start: Instant::now() }
    }

    fn at(&self, seconds: u64) -> Instant {
        self.start + Duration::from_secs(seconds)
    }

    fn claim(&mut self, evaluator: &str, seconds: u64) -> JobReply {
        let request = JobRequest { evaluator: name(evaluator), environments: vec!["ant".into(), "hopper".into()] };
        let now = self.at(seconds);
        self.board.claim(&request, now)
    }

    fn job(&mut self, evaluator: &str, seconds: u64) -> Job {
        match self.claim(evaluator, seconds) {
            JobReply::Job(job) => job,
            JobReply::Wait { .. } => panic!("no job at {seconds} s"),
        }
    }

    fn progress(&mut self, job: &Job, evaluator: &str, seconds: u64) -> Result<(), Refusal> {
        let progress = Progress {
            evaluator: name(evaluator),
            run: job.run.clone(),
            job: job.id,
            step: job.step,
            episodes_done: 1,
            episodes_total: 5,
            environment_steps: 10,
            episodes: 1,
        };
        let now = self.at(seconds);
        self.board.progress(&progress, now)
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
    let jobs: Vec<_> = (0..4).map(|_| bench.job("a", 0)).collect();
    let handed_out: Vec<_> = jobs.iter().map(|job| (job.step, job.seeds.clone())).collect();
    let expected =
        [(1000, vec![1, 2, 3, 4, 5]), (1000, vec![6, 7]), (2000, vec![11, 12, 13, 14, 15]), (2000, vec![16, 17])];
    assert_eq!(handed_out, expected);
    assert_eq!((jobs[0].weights, jobs[2].weights), (hash(1000), hash(2000)));
    assert_eq!((jobs[0].incarnation, jobs[0].candidates, jobs[0].lease_milliseconds), (INCARNATION, 10, 10_000));
    assert!(matches!(bench.claim("b", 0), JobReply::Wait { milliseconds: 1.. }));
    assert_eq!(bench.board.pending(), 14);
}

#[test]
fn an_evaluator_without_the_environment_gets_nothing() {
    let mut bench = Bench::new();
    for environments in [vec![], vec!["ant".to_owned()]] {
        let request = JobRequest { evaluator: name("a"), environments };
        let now = bench.at(0);
        assert!(matches!(bench.board.claim(&request, now), JobReply::Wait { .. }));
    }
}

#[test]
fn scores_complete_a_job_and_an_evaluation_once() {
    let mut bench = Bench::new();
    let (first, second) = (bench.job("a", 0), bench.job("b", 0));
    let (screened, recorded) = bench.deliver(&full_report(&first, "a")).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates), (5, 0));
    assert_eq!(recorded, Recorded { job_completed: true, evaluation_completed: None });
    assert_eq!(bench.board.pending(), 9);

    let (_, recorded) = bench.deliver(&full_report(&second, "b")).unwrap();
    let seeds: Vec<_> = recorded.evaluation_completed.unwrap().iter().map(|score| score.seed).collect();
    assert_eq!(seeds, Vec::from_iter(1..=7), "in the order of the evaluation's seeds");
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
    let (job, rest) = (bench.job("a", 0), bench.job("a", 0));
    bench.deliver(&full_report(&job, "a")).unwrap();
    let changed = report(&job, "a", vec![score(1, 3000.0)]);
    assert_eq!(bench.deliver(&changed).unwrap().0.duplicates, 1);
    let (_, recorded) = bench.deliver(&full_report(&rest, "a")).unwrap();
    let scores = recorded.evaluation_completed.unwrap();
    assert!(scores.iter().all(|score| score.episode_return == 500.0));
}

#[test]
fn a_job_may_be_delivered_in_parts() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let (_, recorded) = bench.deliver(&report(&job, "a", vec![score(1, 0.0), score(3, 0.0)])).unwrap();
    assert!(!recorded.job_completed);
    assert_eq!(bench.board.pending(), 12);
    let (screened, recorded) = bench.deliver(&full_report(&job, "a")).unwrap();
    assert_eq!((screened.new.len(), screened.duplicates, recorded.job_completed), (3, 2, true));
}

#[test]
fn a_lease_that_runs_out_gives_the_unscored_episodes_to_the_next() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    bench.deliver(&report(&lost, "a", vec![score(2, 0.0)])).unwrap();
    let at_9 = bench.at(9);
    assert_eq!(bench.board.expire(at_9), 0);
    let at_10 = bench.at(10);
    assert_eq!(bench.board.expire(at_10), 1);
    assert_eq!(bench.board.expire(at_10), 0, "only once");
    let next = bench.job("b", 10);
    assert_eq!((next.step, next.seeds), (1000, vec![1, 3, 4, 5, 6]));
    assert_ne!(next.id, lost.id);
}

#[test]
fn progress_extends_the_lease_of_its_job_only() {
    let mut bench = Bench::new();
    let (alive, lost) = (bench.job("a", 0), bench.job("b", 0));
    for seconds in [5, 14, 23] {
        bench.progress(&alive, "a", seconds).unwrap();
    }
    let now = bench.at(24);
    assert_eq!(bench.board.expire(now), 1);
    let next = bench.job("c", 24);
    assert_eq!(next.seeds, lost.seeds);
    let end = bench.at(33);
    assert_eq!(bench.board.expire(end), 1, "10 s after the last progress");
}

#[test]
fn progress_of_others_is_refused_and_extends_nothing() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    assert_eq!(bench.progress(&job, "b", 9), Err(Refusal::Evaluator));
    assert_eq!(bench.progress(&Job { id: 99, ..job.clone() }, "a", 9), Err(Refusal::Job));
    assert_eq!(bench.progress(&Job { run: name("other"), ..job }, "a", 9), Err(Refusal::Run));
    let now = bench.at(10);
    assert_eq!(bench.board.expire(now), 1);
}

#[test]
fn progress_does_not_bring_back_a_job_that_was_taken_away() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    let now = bench.at(10);
    bench.board.expire(now);
    bench.progress(&job, "a", 11).unwrap();
    assert_eq!(bench.job("b", 11).seeds, job.seeds);
    let end = bench.at(21);
    assert_eq!(bench.board.expire(end), 1, "b's alone");
}

#[test]
fn an_evaluator_that_goes_loses_all_its_jobs_and_nobody_elses() {
    let mut bench = Bench::new();
    let (first, other, third) = (bench.job("a", 0), bench.job("b", 0), bench.job("a", 0));
    assert_eq!(bench.board.evaluator_gone(&name("a")), 2);
    assert_eq!(bench.board.evaluator_gone(&name("a")), 0);
    let again = [bench.job("c", 0), bench.job("c", 0)];
    assert_eq!([&again[0].seeds, &again[1].seeds], [&first.seeds, &third.seeds]);
    assert!(bench.deliver(&full_report(&other, "b")).unwrap().1.job_completed);
}

#[test]
fn whoever_delivers_first_counts_when_a_lost_evaluator_comes_back() {
    let mut bench = Bench::new();
    let lost = bench.job("a", 0);
    let now = bench.at(10);
    bench.board.expire(now);
    let again = bench.job("b", 10);
    let (screened, recorded) = bench.deliver(&full_report(&lost, "a")).unwrap();
    assert_eq!((screened.new.len(), recorded.job_completed), (5, false), "late, but nobody had been faster");
    assert!(matches!(bench.job("c", 11).seeds[..], [6, 7]), "nothing of it is handed out again");
    let (screened, recorded) = bench.deliver(&full_report(&again, "b")).unwrap();
    assert_eq!((screened.duplicates, recorded.job_completed), (5, true));
    assert_eq!(bench.board.pending(), 9);
}

#[test]
fn a_report_that_is_not_of_this_job_is_refused() {
    let mut bench = Bench::new();
    let (job, other) = (bench.job("a", 0), bench.job("b", 0));
    let good = full_report(&job, "a");
    let with_episode = |episode: EpisodeScore| ScoreReport { episodes: vec![episode], ..good.clone() };
    let twice = ScoreReport { episodes: vec![score(1, 0.0), score(1, 0.0)], ..good.clone() };
    let cases = [
        (ScoreReport { run: name("other"), ..good.clone() }, Refusal::Run),
        (ScoreReport { incarnation: INCARNATION - 1, ..good.clone() }, Refusal::Incarnation),
        (ScoreReport { job: 99, ..good.clone() }, Refusal::Job),
        (ScoreReport { job: other.id, ..good.clone() }, Refusal::Evaluator),
        (ScoreReport { evaluator: name("b"), ..good.clone() }, Refusal::Evaluator),
        (ScoreReport { step: 2000, ..good.clone() }, Refusal::Step),
        (ScoreReport { weights: hash(2000), ..good.clone() }, Refusal::Weights),
        (with_episode(score(6, 0.0)), Refusal::Seed(6)),
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

#[test]
fn an_evaluation_asked_for_twice_is_one() {
    let mut bench = Bench::new();
    let job = bench.job("a", 0);
    bench.board.add_evaluation(1000, hash(1000), &Vec::from_iter(1..=7)).unwrap();
    assert_eq!((bench.board.pending(), bench.job("b", 0).seeds), (14, vec![6, 7]));
    assert_eq!(job.seeds.len(), 5);
}
