//! Batches of episodes.

use std::collections::HashSet;

use quad_dataset::environment::find;
use quad_evaluator::sim::{
    Environment, EnvironmentError, Environments, Rollout, Simulations, Step, make,
};
use quad_protocol::{Episode, EpisodeScore, Hash, Message, Name};
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
    let n = noise.len();
    assert_eq!((observations.len(), actions.len()), (11 * n, 3 * n));
    for (i, noise) in noise.iter_mut().enumerate() {
        act(&observations[11 * i..], noise, &mut actions[3 * i..3 * (i + 1)]);
    }
    Ok(())
}

fn hopper(seeds: &[u64]) -> Rollout<ChaCha8Rng> {
    let make = || Simulations.make("hopper", 0);
    Rollout::new(make, (11, 3), seeds, ChaCha8Rng::seed_from_u64).unwrap()
}

fn run(seeds: &[u64]) -> Vec<EpisodeScore> {
    let mut rollout = hopper(seeds);
    let (mut steps, mut ended) = (0, 0);
    while !rollout.is_done() {
        let stepped = rollout.step(select).unwrap();
        (steps, ended) = (steps + stepped.steps, ended + stepped.ended as usize);
    }
    let scores = rollout.into_scores();
    let lengths = scores.iter().map(|episode| u64::from(episode.length));
    assert_eq!((steps, ended), (lengths.sum(), seeds.len()));
    scores
}

#[test]
fn a_score_depends_on_its_seed_alone() {
    let seeds: Vec<u64> = (0..12).map(|i| i * 7919 + 3).collect();
    let together = run(&seeds);
    for (episode, &seed) in together.iter().zip(&seeds) {
        assert_eq!(run(&[seed]), [*episode]);
    }
    let lengths: HashSet<u32> = together.iter().map(|episode| episode.length).collect();
    assert!(lengths.len() > 1, "some leave the batch before others");
}

#[test]
fn a_score_equals_that_of_stepping_the_environment() {
    let mut hopper = make(find("hopper").unwrap(), 0).unwrap();
    for episode in run(&[5, 6]) {
        let mut noise = ChaCha8Rng::seed_from_u64(episode.seed);
        let (mut episode_return, mut length) = (0.0, 0);
        hopper.reset(episode.seed);
        loop {
            let observation = hopper.observation().iter().map(|&value| value as f32);
            let mut action = [0.0; 3];
            act(&Vec::from_iter(observation), &mut noise, &mut action);
            let step = hopper.step(&action);
            episode_return += step.reward;
            length += 1;
            if step.terminated || step.truncated {
                break;
            }
        }
        assert_eq!(episode.episode_return, episode_return);
        assert_eq!(episode.length, length);
        let score = 100.0 * (episode_return + 20.272305) / (3234.3 + 20.272305);
        assert_eq!(episode.score, score);
    }
}

/// Observes and rewards its number of steps, of which there are four.
#[derive(Clone, Copy, Default)]
struct Counter {
    /// Step and seed.
    state: [f64; 2],
    breaks: bool,
    third_reward: Option<f64>,
    score: f64,
}

impl Environment for Counter {
    fn name(&self) -> &str {
        "counter"
    }

    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.state = [0.0, seed as f64];
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        assert_eq!(action, [0.5]);
        self.state[0] += 1.0;
        let steps = self.state[0];
        if self.breaks && steps == 3.0 {
            let (name, reason) = ("counter".to_owned(), "a cable is loose".to_owned());
            return Err(EnvironmentError::Failed { name, reason });
        }
        let reward = self.third_reward.filter(|_| steps == 3.0).unwrap_or(steps);
        Ok(Step { reward, terminated: steps == 4.0, ..Step::default() })
    }

    fn observation(&self) -> &[f64] {
        &self.state
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(episode_return * self.score)
    }
}

fn count(counter: Counter, sizes: (usize, usize)) -> Result<Vec<EpisodeScore>, EnvironmentError> {
    let make = || Ok(Box::new(counter) as Box<dyn Environment>);
    let mut rollout = Rollout::new(make, sizes, &[7, 8], |_| ())?;
    while !rollout.is_done() {
        rollout.step(|observations, _, actions| {
            assert_eq!(observations, [observations[0], 7.0, observations[0], 8.0]);
            actions.fill(0.5);
            Ok::<_, EnvironmentError>(())
        })?;
    }
    Ok(rollout.into_scores())
}

#[test]
fn any_environment_has_its_own_scores_and_errors() {
    let score = 0.1;
    let mut counter = Counter { score, ..Counter::default() };
    for (episode, seed) in count(counter, (2, 1)).unwrap().into_iter().zip([7, 8]) {
        assert_eq!((episode.seed, episode.length), (seed, 4));
        assert_eq!((episode.episode_return, episode.score), (10.0, 1.0));
    }
    let other_size = count(counter, (3, 1)).unwrap_err().to_string();
    assert_eq!(other_size, "an observation has 2 numbers, but the policy takes 3");
    counter.breaks = true;
    let broken = count(counter, (2, 1)).unwrap_err().to_string();
    assert_eq!(broken, "the environment \"counter\" failed: a cable is loose");
}

/// Ends after as many steps as its seed: terminates with seed 1, is truncated with 2, both with 3.
/// A person takes the second step.
#[derive(Default)]
struct Scripted([f64; 2]);

impl Environment for Scripted {
    fn name(&self) -> &str {
        "scripted"
    }

    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.0 = [seed as f64, 0.0];
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        self.0[1] += 1.0;
        let [seed, steps] = self.0;
        let (reward, terminated) = (steps / 4.0, steps == seed && seed != 2.0);
        let intervention = (steps == 2.0).then(|| vec![action[0] + 90.0]);
        let truncated = steps == seed && seed != 1.0;
        Ok(Step { reward, terminated, truncated, intervention, clipped: None })
    }

    fn observation(&self) -> &[f64] {
        &self.0
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(2.0 * episode_return)
    }
}

#[test]
fn a_recorded_episode_is_what_was_observed_and_done() {
    let weights = Hash::new(b"weights");
    let play = |seeds: &[u64]| {
        let make = || Ok(Box::new(Scripted::default()) as Box<dyn Environment>);
        let rollout = Rollout::new(make, (2, 1), seeds, |_| ()).unwrap();
        let mut rollout = rollout.recording(70, weights, &Name::new("f32").unwrap());
        while !rollout.is_done() {
            // A policy that fails leaves no trace.
            assert!(rollout.step(|_, _, _| Err(anyhow::anyhow!("no action"))).is_err());
            let select = |observations: &[f32], _: &mut [()], actions: &mut [f32]| {
                let rows = observations.chunks_exact(2).zip(actions);
                rows.for_each(|(row, action)| *action = 10.0 * row[0] + row[1]);
                Ok::<_, EnvironmentError>(())
            };
            rollout.step(select).unwrap();
        }
        Vec::from_iter(rollout.into_records().into_iter().map(|(_, episode)| episode.unwrap()))
    };
    let together = play(&[3, 1, 2]);
    for (episode, (seed, observed, actions, person)) in together.iter().zip([
        (3, &[3., 0., 3., 1., 3., 2., 3., 3.][..], &[30., 121., 32.][..], &[1][..]),
        (1, &[1., 0., 1., 1.], &[10.], &[]),
        (2, &[2., 0., 2., 1., 2., 2.], &[20., 111.], &[1]),
    ]) {
        assert_eq!((episode.step, episode.weights, episode.terminated), (70, weights, seed != 2));
        assert_eq!((&episode.observations[..], &episode.actions[..]), (observed, actions));
        assert_eq!(episode.rewards, [0.25, 0.5, 0.75][..seed as usize]);
        assert_eq!(episode.interventions, person);
        let episode_return = [0.25, 0.75, 1.5][seed as usize - 1];
        let score =
            EpisodeScore { seed, episode_return, length: seed as u32, score: 2.0 * episode_return };
        assert_eq!(episode.score, score);
        assert_eq!(play(&[seed])[0], *episode);
    }
    // A score is the policy's alone.
    let make = || Ok(Box::new(Scripted::default()) as Box<dyn Environment>);
    let mut scored = Rollout::new(make, (2, 1), &[3], |_| ()).unwrap();
    let mut step = || scored.step(|_, _, _| Ok::<_, EnvironmentError>(()));
    step().unwrap();
    assert!(matches!(step(), Err(EnvironmentError::Intervention(3))));
    let endless = &play(&[u64::MAX])[0];
    assert_eq!((endless.rewards.len(), endless.terminated), (Episode::LONGEST, false));
}

/// A learner would refuse them.
#[test]
fn returns_and_scores_that_do_not_count_are_errors_as_soon_as_they_are_known() {
    let count = |reward, score| {
        let mut counter = Counter::default();
        (counter.third_reward, counter.score) = (Some(reward), score);
        count(counter, (2, 1))
    };
    for (reward, score, what, value, steps) in [
        (f64::NAN, 0.1, "return", "NaN", 3),
        (f64::NEG_INFINITY, 0.1, "return", "-inf", 3),
        (2e12, 0.1, "return", "2000000000007", 4),
        (3.0, f64::NAN, "score", "NaN", 4),
        (3.0, -1e12, "score", "-10000000000000", 4),
    ] {
        let error = count(reward, score).unwrap_err().to_string();
        let problem =
            format!("the {what} of the episode with seed 8 is {value} after {steps} steps");
        assert_eq!(error, format!("{problem}, not a finite number up to 1e12"));
    }
    let largest = count(1e12 - 7.0, 1.0).unwrap();
    assert_eq!(largest[0].score, 1e12);
}

/// Observes 1 and its number of steps, and pays that; from step `at` on it gives `value` in one of them.
#[derive(Clone, Copy)]
struct Diverging {
    at: u32,
    pays: bool,
    value: f64,
    state: [f64; 2],
}

impl Environment for Diverging {
    fn name(&self) -> &str {
        "diverging"
    }

    fn reset(&mut self, _: u64) -> Result<(), EnvironmentError> {
        let bad = self.at == 0 && !self.pays;
        self.state = [1.0, if bad { self.value } else { 0.0 }];
        Ok(())
    }

    fn step(&mut self, _: &[f32]) -> Result<Step, EnvironmentError> {
        let steps = self.state[1] + 1.0;
        let given = if steps >= f64::from(self.at) { self.value } else { steps };
        let reward = if self.pays { given } else { steps };
        self.state[1] = if self.pays { steps } else { given };
        Ok(Step { reward, truncated: steps == 9.0, ..Step::default() })
    }

    fn observation(&self) -> &[f64] {
        &self.state
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(episode_return)
    }
}

fn diverge(environment: Diverging, online: bool) -> Result<Option<Episode>, EnvironmentError> {
    let make = || Ok(Box::new(environment) as Box<dyn Environment>);
    let mut rollout = Rollout::new(make, (2, 1), &[7], |_| ())?;
    if online {
        rollout = rollout.recording(0, Hash::new(b""), &Name::new("f32").unwrap());
    }
    while !rollout.is_done() {
        rollout.step(|_, _, _| Ok::<_, EnvironmentError>(()))?;
    }
    Ok(rollout.into_records().remove(0).1)
}

#[test]
fn an_online_episode_ends_before_a_step_that_cannot_be_learned_from() {
    for (pays, value) in [
        (false, f64::NAN),
        (false, f64::NEG_INFINITY),
        (false, 1e39),
        (true, f64::NAN),
        (true, 1e39),
        (true, 1e13),
    ] {
        let environment = Diverging { at: 3, pays, value, state: [0.0; 2] };
        let episode = diverge(environment, true).unwrap().unwrap();
        assert_eq!(episode.observations, [1.0, 0.0, 1.0, 1.0, 1.0, 2.0]);
        assert_eq!((&*episode.rewards, episode.terminated), (&[1.0, 2.0][..], false));
        assert_eq!((episode.score.length, episode.score.episode_return), (2, 3.0));
        episode.verify().unwrap();

        let name = if pays { "reward[0]" } else { "observation[1]" };
        let error = diverge(Diverging { at: 1, ..environment }, true).unwrap_err().to_string();
        let expected = format!("\"diverging\" gave {name} = {value} after step 1 of the episode");
        assert!(error.contains(&expected), "{error}");
    }
    let nan = Diverging { at: 0, pays: false, value: f64::NAN, state: [0.0; 2] };
    for online in [true, false] {
        for at in if online { 0..=0 } else { 0..=5 } {
            let error = diverge(Diverging { at, ..nan }, online).unwrap_err().to_string();
            let expected =
                format!("observation[1] = NaN after step {at} of the episode with seed 7");
            assert!(error.contains(&expected), "{error}");
        }
    }
}

#[test]
fn an_episode_has_the_actions_that_were_taken() {
    let make = || Simulations.make("hopper", 0);
    let mut rollout = Rollout::new(make, (11, 3), &[7], |_| ()).unwrap();
    rollout = rollout.recording(0, Hash::new(b""), &Name::new("f32").unwrap());
    while !rollout.is_done() {
        let act = |actions: &mut [f32]| actions.copy_from_slice(&[1.5, -0.25, -2.0]);
        let step = |_: &[f32], _: &mut [_], actions: &mut [f32]| {
            act(actions);
            Ok::<_, EnvironmentError>(())
        };
        rollout.step(step).unwrap();
    }
    let episode = rollout.into_records().remove(0).1.unwrap();
    assert!(episode.actions.chunks_exact(3).all(|action| action == [1.0, -0.25, -1.0]));
}
