//! What becomes of a run that goes and comes again while its client stays.

use quad_service::{Endpoints, open_session};

use super::*;

#[tokio::test(flavor = "multi_thread")]
async fn a_run_that_comes_again_is_as_proven_as_its_client_knows() {
    let endpoints = Endpoints { listen: vec!["tcp/127.0.0.1:0".to_owned()], ..Endpoints::default() };
    let session = open_session(&endpoints).await.unwrap();
    let found =
        |life| Found { session: session.clone(), lives: [life].into(), since: Instant::now(), proven: Arc::default() };
    let identity = Identity { evaluator: Name::new("evaluator").unwrap(), precision: Name::new("f32").unwrap() };
    let shared = (Arc::new(Notify::new()), Budget::new(1 << 20));
    let lives = [found(1), found(2), found(3)];
    let proven = || [0, 1, 2].map(|life| lives[life].proven.load(Relaxed));
    let attached = RunClient::attach(Name::new("run").unwrap(), &lives[0], identity, Metrics::new().unwrap(), shared);
    let mut client = attached.await.unwrap();
    client.follow(&lives[1]);
    assert_eq!((client.incarnation, proven()), (2, [false; 3]));
    // Scores that were accepted after it had come again count for it, and for its next life.
    client.proven.store(true, Relaxed);
    assert_eq!(proven(), [false, true, false]);
    client.follow(&lives[2]);
    assert_eq!(proven(), [false, true, true]);
}
