//! A learner starts at once: reading is no wait.

use std::time::Duration;

use quad_dataset::{D4rlWriter, Metadata, ReadOptions, RewardRule, Row, Scale, Transitions};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tempfile::tempdir;

use crate::hopper;

#[test]
fn a_hundred_thousand_transitions_load_in_half_a_second() {
    let folder = tempdir().unwrap();
    let path = folder.path().join("rows.hdf5");
    let mut writer = D4rlWriter::create(&path, hopper()).unwrap();
    let mut generator = ChaCha8Rng::seed_from_u64(0);
    let mut numbers = [0.0; 37];
    for i in 0..100_001 {
        numbers.copy_within(14..25, 0);
        numbers[11..].fill_with(|| generator.random_range(-1.0..1.0));
        let row = Row {
            observation: &numbers[..11],
            action: &numbers[11..14],
            next_observation: &numbers[14..25],
            reward: numbers[0],
            terminal: i % 500 == 0,
            timeout: false,
            qpos: &numbers[25..31],
            qvel: &numbers[31..],
        };
        writer.push(&row).unwrap();
    }
    writer.finish(&Metadata { algorithm: "noise", iteration: 0, seed: 0 }).unwrap();

    let options = ReadOptions { environment: Some(hopper()), reward: RewardRule::Locomotion, scale: Scale::default() };
    // This thread's time on a processor: a busy machine is not this crate's doing.
    let spent = || {
        std::thread::yield_now();
        let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap();
        Duration::from_nanos(text.split(' ').next().unwrap().parse().unwrap())
    };
    let timed = || {
        let start = spent();
        assert_eq!(Transitions::read(&path, &options).unwrap().len(), 100_000);
        spent() - start
    };
    let best = (0..5).map(|_| timed()).min().unwrap();
    eprintln!("100,000 transitions in {best:?}");
    assert!(best < Duration::from_millis(500), "{best:?}");
}
