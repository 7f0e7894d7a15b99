//! That health tells whether the worker is stuck.

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};

use quad_policy::{ActionNoise, Cost, PolicyError};
use quad_protocol::Lease;
use quad_service::{Endpoints, Health, open_session};

use super::super::discovery::Found;
use super::*;

const LIMIT: Duration = Duration::from_secs(1);

/// Acts slowly, and once very slowly.
struct Sleeper {
    stuck_at: u32,
    calls: AtomicU32,
}

impl Policy for Sleeper {
    fn kind(&self) -> &'static str {
        "sleeper"
    }

    fn observation_dim(&self) -> usize {
        11
    }

    fn action_dim(&self) -> usize {
        3
    }

    fn samples_candidates(&self) -> bool {
        false
    }

    fn cost(&self, _: usize, _: usize) -> Cost {
        Cost { bytes: 0, products: 0 }
    }

    fn act(&self, _: &[f32], _: usize, _: &mut [ActionNoise], actions: &mut [f32]) -> Result<(), PolicyError> {
        let stuck = self.calls.fetch_add(1, Relaxed) == self.stuck_at;
        std::thread::sleep(if stuck { 4 * LIMIT } else { LIMIT / 60 });
        actions.fill(0.0);
        Ok(())
    }
}

/// Whether anything was wrong while `work` went on.
async fn ailed(health: Health, work: impl Future<Output = ()>) -> bool {
    let ailed = AtomicBool::new(false);
    let watch = async {
        loop {
            ailed.fetch_or(!health.problems().is_empty(), Relaxed);
            tokio::time::sleep(LIMIT / 20).await;
        }
    };
    tokio::select! {
        () = work => ailed.load(Relaxed),
        () = watch => ailed.load(Relaxed),
    }
}

fn worker(health: &Health, found: watch::Receiver<Runs>) -> Worker {
    let (name, metrics) = (Name::new("worker").unwrap(), Metrics::new().unwrap());
    Worker::new(name, Precision::F32, metrics, found, health.part("worker", LIMIT)).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_to_do_is_no_illness() {
    let (health, (_keep, found)) = (Health::default(), watch::channel(Runs::new()));
    let worker = worker(&health, found);
    let idle = async { drop(tokio::time::timeout(4 * LIMIT, worker.run()).await) };
    assert!(!ailed(health, idle).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_long_job_is_well_and_a_stuck_one_is_not() {
    let endpoints = Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
    let session = open_session(&endpoints).await.unwrap();
    let run = Name::new("run").unwrap();
    for (stuck_at, expected) in [(u32::MAX, false), (3, true)] {
        let (health, (_keep, found)) = (Health::default(), watch::channel(Runs::new()));
        let worker = worker(&health, found);
        let found =
            Found { session: session.clone(), lives: [1].into(), since: Instant::now(), proven: Arc::default() };
        let (metrics, shared) = (worker.metrics.clone(), (worker.snapshot_arrived.clone(), worker.budget.clone()));
        let client = RunClient::attach(run.clone(), &found, worker.identity.clone(), metrics, shared).await;
        let job = Job {
            id: 1,
            lease: Lease::random(),
            run: run.clone(),
            incarnation: 1,
            step: 1,
            weights: Hash::of(b""),
            environment: "hopper".to_owned(),
            instance: 1,
            seeds: vec![1, 2],
            candidates: 1,
            progress_milliseconds: 100,
        };
        let spec = job::check(&job, &run).unwrap();
        let policy = Arc::new(Sleeper { stuck_at, calls: AtomicU32::new(0) });
        let begun = Instant::now();
        let rolled_out = async {
            worker.beat.alive();
            let client = client.unwrap();
            assert_eq!(worker.roll_out(&job, spec, policy, &client).await.unwrap().len(), 2);
            assert!(begun.elapsed() > 2 * LIMIT, "the job took longer than the limit");
        };
        assert_eq!(ailed(health, rolled_out).await, expected, "stuck at {stuck_at}");
    }
}
