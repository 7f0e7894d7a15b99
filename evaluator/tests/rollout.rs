//! Episodes do not depend on the batch they run in, and are what stepping an environment by hand
//! gives.
#![allow(clippy::unwrap_used)]

use quad_dataset::environment::find;
use quad_evaluator::sim::{
    Environment, EnvironmentError, Environments, EpisodeOutcome, Rollout, Simulations, Step, make,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Acts at random around a crude upright stance, from each episode's own stream.
fn act(observation: &[f32], noise: &mut ChaCha8Rng, action: &mut [f32]) {
    for (i, value) in action.iter_mut().enumerate() {
        *value = -2.0 * observation[1] - observation[2 + i] + noise.random_range(-0.8..0.8);
    }
}

fn select(
    observations: &[f32],
    noise: &mut [ChaCha8Rng],
    actions: &mut [f32],
) -> Result<(), EnvironmentError> {
    assert_eq!(observations.len(), 11 * noise.len());
    assert_eq!(actions.len(), 3 * noise.len());
    for ((observation, noise), action) in
        observations.chunks(11).zip(noise).zip(actions.chunks_mut(3))
    {
        act(observation, noise, action);
    }
    Ok(())
}

fn hopper<S>(seeds: &[u64], begin: impl FnMut(u64) -> S) -> Rollout<S> {
    Rollout::new(|| Simulations.make("hopper", 0), (11, 3), seeds, begin).unwrap()
}

fn run(seeds: &[u64]) -> Vec<EpisodeOutcome> {
    let mut rollout = hopper(seeds, ChaCha8Rng::seed_from_u64);
    let mut steps = 0;
    while !rollout.is_done() {
        rollout.step(select).unwrap();
        steps += 1;
        assert!(steps <= 1000, "an episode outlived the time limit");
    }
    assert_eq!(rollout.episodes_done(), seeds.len());
    let environment_steps = rollout.environment_steps();
    let outcomes = rollout.into_outcomes();
    assert_eq!(
        environment_steps,
        outcomes.iter().map(|outcome| u64::from(outcome.length)).sum::<u64>()
    );
    outcomes
}

#[test]
fn an_outcome_depends_on_its_seed_alone() {
    let seeds: Vec<u64> = (0..12).map(|i| i * 7919 + 3).collect();
    let together = run(&seeds);
    assert_eq!(together.iter().map(|outcome| outcome.seed).collect::<Vec<_>>(), seeds);
    for (outcome, &seed) in together.iter().zip(&seeds) {
        let alone = run(&[seed])[0];
        assert_eq!(alone, EpisodeOutcome { index: 0, ..*outcome });
    }
    let lengths: std::collections::HashSet<u32> =
        together.iter().map(|outcome| outcome.length).collect();
    assert!(lengths.len() > 1, "episodes of one length only prove nothing about leaving the batch");
}

#[test]
fn an_outcome_is_what_stepping_by_hand_gives() {
    let spec = find("hopper").unwrap();
    let mut hopper = make(spec, 0).unwrap();
    for outcome in run(&[5, 6]) {
        let mut noise = ChaCha8Rng::seed_from_u64(outcome.seed);
        let (mut episode_return, mut length) = (0.0, 0);
        hopper.reset(outcome.seed);
        loop {
            let observation: Vec<f32> =
                hopper.observation().iter().map(|&value| value as f32).collect();
            let mut action = [0.0; 3];
            act(&observation, &mut noise, &mut action);
            let step = hopper.step(&action);
            episode_return += step.reward;
            length += 1;
            if step.terminated || step.truncated {
                break;
            }
        }
        assert_eq!((outcome.episode_return, outcome.length), (episode_return, length));
        assert_eq!(outcome.score, 100.0 * (episode_return + 20.272305) / (3234.3 + 20.272305));
    }
}

#[test]
fn a_policy_that_fails_stops_the_batch_where_it_is() {
    let mut rollout = hopper(&[1, 2], ChaCha8Rng::seed_from_u64);
    rollout.step(select).unwrap();
    let failed = rollout.step(|_, _, _| Err(anyhow::anyhow!("no action")));
    assert_eq!(failed.unwrap_err().to_string(), "no action");
    assert_eq!((rollout.environment_steps(), rollout.episodes_done()), (2, 0));
    rollout.step(select).unwrap();
    assert_eq!(rollout.environment_steps(), 4);
}

/// An environment of another make: it observes and pays how many steps it has taken. In the third
/// it breaks down if it is to, or pays something else.
struct Made {
    steps: [f64; 2],
    breaks: bool,
    pays: Option<f64>,
    worth: f64,
}

impl Environment for Made {
    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.steps = [0.0, seed as f64];
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        assert_eq!(action, [0.5]);
        self.steps[0] += 1.0;
        if self.breaks && self.steps[0] == 3.0 {
            return Err(EnvironmentError::Failed {
                name: "made".to_owned(),
                reason: "a cable is loose".to_owned(),
            });
        }
        let reward = self.pays.filter(|_| self.steps[0] == 3.0).unwrap_or(self.steps[0]);
        Ok(Step { reward, terminated: self.steps[0] == 4.0, truncated: false })
    }

    fn observation(&self) -> &[f64] {
        &self.steps
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(episode_return * self.worth)
    }
}

fn made(breaks: bool, sizes: (usize, usize)) -> Result<Vec<EpisodeOutcome>, EnvironmentError> {
    roll_out(|| Made { steps: [0.0; 2], breaks, pays: None, worth: 0.1 }, sizes)
}

fn roll_out(
    made: impl Fn() -> Made,
    sizes: (usize, usize),
) -> Result<Vec<EpisodeOutcome>, EnvironmentError> {
    let make = || Ok(Box::new(made()) as Box<dyn Environment>);
    let mut rollout = Rollout::new(make, sizes, &[7, 8], |_| ())?;
    while !rollout.is_done() {
        rollout.step(|observations, _, actions| {
            assert_eq!(observations, [observations[0], 7.0, observations[0], 8.0]);
            actions.fill(0.5);
            Ok::<_, EnvironmentError>(())
        })?;
    }
    Ok(rollout.into_outcomes())
}

#[test]
fn an_environment_of_another_make_has_scores_of_its_own() {
    let outcome =
        |index, seed| EpisodeOutcome { index, seed, episode_return: 10.0, length: 4, score: 1.0 };
    assert_eq!(made(false, (2, 1)).unwrap(), [outcome(0, 7), outcome(1, 8)]);
}

#[test]
fn an_environment_that_breaks_down_or_does_not_fit_says_so() {
    let error = |breaks, sizes| made(breaks, sizes).unwrap_err().to_string();
    assert_eq!(error(true, (2, 1)), "the environment \"made\" failed: a cable is loose");
    assert_eq!(error(false, (3, 1)), "an observation has 2 numbers, but the policy takes 3");
}

/// No episode counts whose return or score a learner would refuse; one that cannot come right again
/// does not go on.
#[test]
fn a_return_or_score_that_cannot_count_is_told_as_soon_as_it_is_known() {
    let told = |pays, worth| {
        roll_out(|| Made { steps: [0.0; 2], breaks: false, pays: Some(pays), worth }, (2, 1))
    };
    for (pays, worth, sentence) in [
        (f64::NAN, 0.1, "the return of the episode with seed 8 is NaN after 3 steps"),
        (f64::NEG_INFINITY, 0.1, "the return of the episode with seed 8 is -inf after 3 steps"),
        (2e12, 0.1, "the return of the episode with seed 8 is 2000000000007 after 4 steps"),
        (3.0, f64::NAN, "the score of the episode with seed 8 is NaN after 4 steps"),
        (3.0, -1e12, "the score of the episode with seed 8 is -10000000000000 after 4 steps"),
    ] {
        assert_eq!(
            told(pays, worth).unwrap_err().to_string(),
            format!("{sentence}, not a finite number up to 1e12")
        );
    }
    assert_eq!(told(1e12 - 7.0, 1.0).unwrap()[0].score, 1e12, "the largest that counts");
}
