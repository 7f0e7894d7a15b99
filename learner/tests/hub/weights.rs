//! Snapshots are published, and answered from the disk.

use std::time::Duration;

use quad_protocol::{Hash, Snapshot, decode, keys};

use crate::bench::{Bench, PATIENCE, ask, file};

#[tokio::test(flavor = "multi_thread")]
async fn weights_are_published_and_older_ones_are_answered_from_the_disk() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let published = client.declare_subscriber(keys::weights(&bench.run)).await.unwrap();
    tokio::time::sleep(Duration::from_millis(200)).await; // the learner learns of the subscription
    bench.snapshot(10).await;
    let sample = tokio::time::timeout(PATIENCE, published.recv_async()).await.unwrap().unwrap();
    assert_eq!(decode::<Snapshot>(&sample.payload().to_bytes()).unwrap().step, 10);
    bench.snapshot(20).await;
    for step in [10, 20] {
        let snapshot: Snapshot = ask(&client, keys::weights_at(&bench.run, step), None).await.unwrap().unwrap();
        assert_eq!((snapshot.step, snapshot.hash, snapshot.tensors), (step, Hash::of(&file(step)), file(step)));
    }
    let missing = ask::<Snapshot>(&client, keys::weights_at(&bench.run, 11), None).await.unwrap();
    assert!(missing.unwrap_err().contains("no snapshot"));

    let path = bench.run_dir.path().join("snapshots/step_000000010.safetensors");
    std::fs::write(path, "something else").unwrap();
    let changed = ask::<Snapshot>(&client, keys::weights_at(&bench.run, 10), None).await.unwrap();
    assert!(changed.unwrap_err().contains("was changed"));
}
