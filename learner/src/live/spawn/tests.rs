//! Tests of `live/spawn.rs`.

use std::time::Duration;

use quad_runtime::Health;
use tokio::sync::mpsc::unbounded_channel;

use super::*;

#[test]
fn a_thread_that_fails_or_panics_tells_the_main_loop_why() {
    let (events, mut told) = unbounded_channel();
    let mut failed = |work: fn() -> anyhow::Result<()>| {
        spawn("scores", &events, work).unwrap().join().unwrap();
        match told.try_recv() {
            Ok(Event::Failed(error)) => error.to_string(),
            other => panic!("{other:?}"),
        }
    };
    let panicked = failed(|| panic!("a test's own {}", "panic"));
    assert!(
        panicked.contains("`scores` panicked") && panicked.contains("a test's own panic"),
        "{panicked}"
    );
    assert_eq!(failed(|| Err(anyhow!("no such thing"))), "no such thing");

    let health = Health::default();
    let beat = health.register("scores", Duration::from_secs(60));
    spawn_alive("scores", &events, beat, |_| panic!("again")).unwrap().join().unwrap();
    assert_eq!(health.problems().len(), 1);
    spawn("scores", &events, || Ok(())).unwrap().join().unwrap();
    assert!(matches!(told.try_recv(), Ok(Event::Failed(_))) && told.try_recv().is_err());
}
