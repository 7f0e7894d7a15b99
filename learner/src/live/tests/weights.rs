//! Snapshots are published, and answered from the disk.

use quad_protocol::Snapshot;

use super::*;

#[tokio::test(flavor = "multi_thread")]
async fn weights_are_published_and_older_ones_are_answered_from_the_disk() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    let published = client.declare_subscriber(keys::weights(&bench.run)).await.unwrap();
    // One may be dropped: before the learner knows of the subscription, or while another test's peer does not read.
    let (start, mut step) = (Instant::now(), 0);
    let sample = loop {
        assert!(start.elapsed() < PATIENCE, "nothing is published");
        step += 10;
        bench.snapshot(step).await;
        if let Ok(sample) = tokio::time::timeout(Duration::from_secs(1), published.recv_async()).await {
            break sample.unwrap();
        }
    };
    let received = decode::<Snapshot>(&sample.payload().to_bytes()).unwrap().step;
    assert!((10..=step).contains(&received), "{received}");
    bench.snapshot(step + 10).await;
    for step in [step, step + 10] {
        let snapshot: Snapshot = ask(&client, keys::weights_at(&bench.run, step), None).await.unwrap().unwrap();
        assert_eq!((snapshot.step, snapshot.hash, snapshot.file), (step, Hash::of(&file(step)), file(step)));
    }
    let missing = ask::<Snapshot>(&client, keys::weights_at(&bench.run, 11), None).await.unwrap();
    assert!(missing.unwrap_err().contains("no snapshot"));

    let path = bench.run_dir.path().join(format!("snapshots/step_{step:09}.safetensors"));
    std::fs::write(path, "something else").unwrap();
    let changed = ask::<Snapshot>(&client, keys::weights_at(&bench.run, step), None).await.unwrap();
    assert!(changed.unwrap_err().contains("was changed"));
}

#[tokio::test(flavor = "multi_thread")]
async fn while_the_disk_hangs_that_is_read_from_claims_are_answered() {
    let mut bench = Bench::start().await;
    let client = bench.client().await;
    for step in [10, 20] {
        bench.snapshot(step).await;
    }
    // To open a pipe for reading takes until another process opens it for writing.
    let path = bench.run_dir.path().join("snapshots/step_000000010.safetensors");
    std::fs::remove_file(&path).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
    for _ in 0..20 {
        client.get(keys::weights_at(&bench.run, 10)).timeout(PATIENCE).callback(drop).await.unwrap();
    }
    tokio::time::sleep(Duration::from_millis(200)).await;
    // Nothing is written to the pipe, so the answer cannot have waited for the disk.
    claim(&client, &bench.run, "a").await.expect("there is work");
}
