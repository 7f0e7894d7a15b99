//! Tests of the order of experience and gradient steps.

use std::sync::atomic::AtomicBool;
use std::sync::mpsc;

use quad_protocol::{Episode, Exploration, Hash, Name, online_seed};
use quad_run::config::{Experiment, Online};

use super::*;
use crate::service::Opening;
use crate::train::{Inbox, OnlineMetrics, OnlineTraining};

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
        ..Episode::new(0, Hash::new(b""), Name::new("f32").unwrap(), 0)
    }
}

fn episodes() -> Vec<Episode> {
    LENGTHS.map(episode).to_vec()
}

/// Online learning whose first episodes have come.
fn online(recorded: &[Episode]) -> (OnlineTraining, Inbox) {
    let metrics = OnlineMetrics::new(&prometheus::Registry::new()).unwrap();
    let (inbox, episodes) = mpsc::channel();
    for (number, episode) in (0..).zip(recorded) {
        inbox.send((number, episode.clone())).unwrap();
    }
    let transitions = Arc::new(transitions());
    (OnlineTraining::new(&experiment(), transitions, episodes, metrics).unwrap(), inbox)
}

/// Trains from a gradient step to the end. Episodes come as late as they may. Returns the openings
/// and the batches.
fn train(
    online: &mut OnlineTraining,
    inbox: &Inbox,
    episodes: &[Episode],
    from: u64,
) -> (Vec<Opening>, Vec<Vec<u32>>) {
    let (mut openings, mut batches, stop) = (Vec::new(), Vec::new(), AtomicBool::new(false));
    for step in from..experiment().total_steps() {
        loop {
            for opening in online.take_openings() {
                let number = opening.episode;
                inbox.send((number, episodes[number as usize].clone())).unwrap();
                openings.push(opening);
            }
            if !online.is_due(step) {
                break;
            }
            assert!(online.absorb_next(&stop, &beat()).unwrap());
        }
        batches.push(online.rows(step + 1).to_vec());
    }
    (openings, batches)
}

/// A run that is resumed at any step opens no episode again, and has the same batches.
fn assert_resumes(episodes: &[Episode], batches: &[Vec<u32>]) {
    for from in BEGIN..experiment().total_steps() {
        let (mut resumed, inbox) = online(episodes);
        resumed.resume(from).unwrap();
        let rest = batches[(from - BEGIN) as usize..].to_vec();
        let trained = train(&mut resumed, &inbox, episodes, from);
        assert_eq!(trained, (vec![], rest), "from step {from}");
    }
}

#[test]
fn the_rows_decide_which_snapshot_plays_and_which_steps_follow() {
    let (mut online, inbox) = online(&[]);
    assert!(!online.has_begun(BEGIN - 1) && online.has_begun(BEGIN));
    let stopped = online.absorb_next(&AtomicBool::new(true), &beat());
    assert!(!stopped.unwrap(), "a wait can be ended");
    let (openings, _) = train(&mut online, &inbox, &episodes(), BEGIN);
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
        let seed = online_seed(0, episode);
        Opening { episode, step, seed, exploration }
    };
    assert_eq!(openings, expected.map(opening));
}

#[test]
fn online_training_continues_from_any_step_as_if_it_had_not_stopped() {
    let episodes = episodes();
    let (mut whole, inbox) = online(&[]);
    let (_, batches) = train(&mut whole, &inbox, &episodes, BEGIN);
    assert_resumes(&episodes, &batches);
    let (mut resumed, _) = online(&episodes[..1]);
    assert!(resumed.resume(experiment().total_steps()).is_err(), "experience is missing");
}

#[test]
fn an_episode_with_a_glitch_counts_as_one_without_rows_also_after_a_restart() {
    let (mut sound, inbox) = online(&[]);
    let (_, expected) = train(&mut sound, &inbox, &episodes(), BEGIN);
    let mut glitch = episode(8);
    glitch.observations[40] = 1e30;
    // In the warm-up, between gradient steps, and two in a row.
    let places = [0, 4, 6, 7];
    let mut episodes = episodes();
    places.iter().for_each(|place| episodes.insert(*place, glitch.clone()));

    let (mut whole, inbox) = online(&[]);
    let (openings, batches) = train(&mut whole, &inbox, &episodes, BEGIN);
    assert_eq!(batches, expected);
    assert_eq!(
        Vec::from_iter(openings.iter().map(|opening| opening.episode)),
        Vec::from_iter(0..11)
    );
    assert_resumes(&episodes, &batches);
}

#[test]
fn the_next_episode_is_waited_for_until_it_is_recorded() {
    let (mut online, inbox) = online(&[]);
    for (number, awaited) in [(1, Some(0)), (0, None)] {
        inbox.send((number, episode(LENGTHS[number as usize]))).unwrap();
        online.take_openings();
        assert_eq!(online.awaited(), awaited);
    }
}

#[test]
fn a_line_of_metrics_has_the_return_of_the_newest_episode() {
    let mut played = episode(3);
    (played.score.episode_return, played.score.score) = (7.0, 3.0);
    let (mut online, _inbox) = online(&[played]);
    assert!(online.absorb_next(&AtomicBool::new(false), &beat()).unwrap());
    assert_eq!(online.row()[1], ("online_return", 7.0));
}
