//! Tests of the order of practice and gradient steps.

use std::sync::atomic::AtomicBool;
use std::sync::mpsc;

use quad_protocol::{Episode, Exploration, Hash, Name, practice_seed};
use quad_run::config::{Experiment, Online};

use super::*;
use crate::service::Opening;
use crate::train::{Inbox, Practice, PracticeMetrics};

/// Rows of the episodes; the first two are exactly the warm-up.
const LENGTHS: [usize; 7] = [3, 2, 5, 5, 1, 9, 5];
const BEGIN: u64 = 10;

/// 20 environment steps with two gradient steps each, after a warm-up of 5.
fn experiment() -> Experiment {
    let mut experiment = resolve("hopper-demo", &toml::Table::new()).unwrap();
    (experiment.steps, experiment.batch_size) = (BEGIN, 4);
    experiment.online = Some(Online {
        steps: 20,
        updates_per_step: 2,
        warmup: 5,
        uniform_warmup: true,
        share: Some(0.5),
        noise: 0.1,
        lag: 2,
        snapshot_interval: 4,
    });
    experiment
}

fn episode(rows: usize) -> Episode {
    Episode {
        terminated: true,
        observations: vec![rows as f32; (rows + 1) * 11],
        actions: vec![0.5; rows * 3],
        rewards: vec![1.0; rows],
        ..Episode::new(0, Hash::of(b""), Name::new("f32").unwrap(), 0)
    }
}

/// Practice whose first `recorded` episodes have come.
fn practice(recorded: usize) -> (Practice, Inbox) {
    let metrics = PracticeMetrics::new(&prometheus::Registry::new()).unwrap();
    let (inbox, episodes) = mpsc::channel();
    for (number, rows) in (0..).zip(&LENGTHS[..recorded]) {
        inbox.send((number, episode(*rows))).unwrap();
    }
    let transitions = Arc::new(transitions());
    (Practice::new(&experiment(), transitions, episodes, metrics).unwrap(), inbox)
}

/// Trains from a gradient step to the end. Episodes come as late as they may. Returns the openings
/// and the batches.
fn train(practice: &mut Practice, inbox: &Inbox, from: u64) -> (Vec<Opening>, Vec<Vec<u32>>) {
    let (mut openings, mut batches, stop) = (Vec::new(), Vec::new(), AtomicBool::new(false));
    for step in from..experiment().total_steps() {
        loop {
            for opening in practice.take_openings() {
                let number = opening.episode;
                inbox.send((number, episode(LENGTHS[number as usize]))).unwrap();
                openings.push(opening);
            }
            if !practice.is_due(step) {
                break;
            }
            assert!(practice.absorb_next(&stop, &beat()).unwrap());
        }
        batches.push(practice.batch(step + 1).to_vec());
    }
    (openings, batches)
}

#[test]
fn the_rows_decide_which_snapshot_plays_and_which_steps_follow() {
    let (mut practice, inbox) = practice(0);
    assert!(!practice.has_begun(BEGIN - 1) && practice.has_begun(BEGIN));
    let stopped = practice.absorb_next(&AtomicBool::new(true), &beat());
    assert!(!stopped.unwrap(), "a wait can be ended");
    let (openings, _) = train(&mut practice, &inbox, BEGIN);
    let noise = Exploration::Policy { noise: 0.1 };
    // After 3, 5, 10, 15 and 16 rows, gradient steps 10, 10, 20, 30 and 32 are due.
    let expected = [
        (0, 10, Exploration::Uniform),
        (1, 10, Exploration::Uniform),
        (2, 10, Exploration::Uniform),
        (3, 10, noise),
        (4, 10, noise),
        (5, 18, noise),
        (6, 30, noise),
    ];
    let opening = |(episode, step, exploration)| {
        let seed = practice_seed(0, episode);
        Opening { episode, step, seed, exploration }
    };
    assert_eq!(openings, expected.map(opening));
}

#[test]
fn practice_continues_from_any_step_as_if_it_had_not_stopped() {
    let (mut whole, inbox) = practice(0);
    let (_, batches) = train(&mut whole, &inbox, BEGIN);
    for from in BEGIN..experiment().total_steps() {
        let (mut resumed, inbox) = practice(LENGTHS.len());
        resumed.resume(from).unwrap();
        let rest = batches[(from - BEGIN) as usize..].to_vec();
        assert_eq!(train(&mut resumed, &inbox, from), (vec![], rest), "from step {from}");
    }
    let (mut resumed, _) = practice(1);
    assert!(resumed.resume(experiment().total_steps()).is_err(), "experience is missing");
}

#[test]
fn the_next_episode_is_waited_for_until_it_is_recorded() {
    let (mut practice, inbox) = practice(0);
    for (number, awaited) in [(1, Some(0)), (0, None)] {
        inbox.send((number, episode(LENGTHS[number as usize]))).unwrap();
        practice.take_openings();
        assert_eq!(practice.awaited(), awaited);
    }
}
