//! Tests of the queue between training and the disk.

use std::sync::atomic::AtomicBool;

use super::*;
use crate::train::results::TrainedPolicy;

#[test]
fn a_queue_that_the_disk_does_not_empty_keeps_all_rows_then_the_newest_checkpoint() {
    let (queue, beat) = (OutputQueue::default(), beat());
    let checkpoint = |step: u64| Checkpoint { step, state: vec![step as u8] };
    for step in 1..=3 {
        let (values, held_out) = (vec![], vec![]);
        let online = Vec::new();
        let row = Row { step, seconds: 0.0, metrics: &[], values, held_out, online };
        queue.push(Output::Rows(vec![row]));
        queue.push(Output::Checkpoint(checkpoint(step)));
    }
    queue.push(Output::Ended(Outcome::Completed));
    queue.close();
    assert!(matches!(queue.next(&beat), Some(Output::Rows(rows)) if rows.len() == 3));
    assert!(
        matches!(queue.next(&beat), Some(Output::Checkpoint(newest)) if newest == checkpoint(3))
    );
    assert!(matches!(queue.next(&beat), Some(Output::Ended(Outcome::Completed))));
    assert!(queue.next(&beat).is_none());
}

/// Adds a snapshot of 150 MiB.
fn add_large(queue: &OutputQueue, step: u64, stop: bool) {
    let policy = TrainedPolicy { step, file: vec![0; 150 << 20], evaluate: true, online: false };
    queue.snapshot(policy, &AtomicBool::new(stop), &beat());
}

#[test]
fn training_waits_only_while_many_bytes_wait_for_the_disk_and_not_after_a_stop() {
    let queue = OutputQueue::default();
    add_large(&queue, 1, false);
    add_large(&queue, 2, false);
    let waits = std::thread::scope(|scope| {
        let third = scope.spawn(|| add_large(&queue, 3, false));
        std::thread::sleep(Duration::from_millis(200));
        let waits = !third.is_finished();
        assert!(matches!(queue.next(&beat()), Some(Output::Snapshot(first)) if first.step == 1));
        waits
    });
    assert!(waits, "300 MiB are too many");
    add_large(&queue, 4, true);
}
