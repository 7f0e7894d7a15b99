//! Batches of episodes.

use std::collections::HashSet;
use std::sync::Arc;

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

#[test]
fn a_score_in_a_batch_is_that_of_stepping_its_environment_alone() {
    let seeds: Vec<u64> = (0..12).map(|i| i * 7919 + 3).collect();
    let make_hopper = || Simulations.make("hopper", 0);
    let mut rollout =
        Rollout::new(make_hopper, (11, 3), &seeds, ChaCha8Rng::seed_from_u64).unwrap();
    let (mut steps, mut ended) = (0, 0);
    while !rollout.is_done() {
        let stepped = rollout.step(|observations, noise, actions| {
            let rows = observations.chunks_exact(11).zip(noise).zip(actions.chunks_exact_mut(3));
            rows.for_each(|((observation, noise), action)| act(observation, noise, action));
            Ok::<_, EnvironmentError>(())
        });
        let stepped = stepped.unwrap();
        (steps, ended) = (steps + stepped.steps, ended + stepped.ended as usize);
    }
    let scores = rollout.into_scores();
    let lengths = scores.iter().map(|episode| u64::from(episode.length));
    assert_eq!((steps, ended), (lengths.clone().sum(), seeds.len()));
    assert!(HashSet::<u64>::from_iter(lengths).len() > 1, "some leave the batch before others");

    let mut hopper = make(find("hopper").unwrap(), 0).unwrap();
    for (episode, seed) in scores.into_iter().zip(seeds) {
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        let (mut episode_return, mut length, mut ended) = (0.0, 0, false);
        hopper.reset(seed);
        while !ended {
            let observation = hopper.observation().iter().map(|&value| value as f32);
            let mut action = [0.0; 3];
            act(&Vec::from_iter(observation), &mut noise, &mut action);
            let step = hopper.step(&action);
            (episode_return, length) = (episode_return + step.reward, length + 1);
            ended = step.terminated || step.truncated;
        }
        let score = 100.0 * (episode_return + 20.272305) / (3234.3 + 20.272305);
        assert_eq!(episode, EpisodeScore { seed, episode_return, length, score });
    }
}

/// Effect of a step, given the observed seed and number of steps, and the action.
type Rules = dyn Fn(&mut [f64; 2], f32) -> Result<Step, EnvironmentError> + Send + Sync;

/// Observes its seed and its number of steps.
#[derive(Clone)]
struct Robot {
    state: [f64; 2],
    /// The second number of the first observation.
    start: f64,
    rules: Arc<Rules>,
    /// Score of a return of 1.
    score: f64,
}

impl Robot {
    fn new(
        rules: impl Fn(&mut [f64; 2], f32) -> Result<Step, EnvironmentError> + Send + Sync + 'static,
    ) -> Self {
        Self { state: [0.0; 2], start: 0.0, rules: Arc::new(rules), score: 1.0 }
    }

    fn problem(&self, online: bool) -> String {
        self.play(&[7], online).unwrap_err().to_string()
    }

    /// Plays the episodes of some seeds; the action is 10 times the seed, plus the steps before it.
    fn play(&self, seeds: &[u64], online: bool) -> Result<Vec<Played>, EnvironmentError> {
        let mut rollout = self.rollout(2, seeds)?;
        if online {
            let precision = Name::new("f32").unwrap();
            rollout = rollout.recording(70, Hash::new(b"weights"), &precision);
        }
        while !rollout.is_done() {
            // A policy that fails leaves no trace.
            assert!(rollout.step(|_, _, _| Err(anyhow::anyhow!("no action"))).is_err());
            rollout.step(|observations, _, actions| {
                let rows = observations.chunks_exact(2).zip(actions);
                rows.for_each(|(row, action)| *action = 10.0 * row[0] + row[1]);
                Ok::<_, EnvironmentError>(())
            })?;
        }
        Ok(rollout.into_records())
    }

    fn rollout(&self, size: usize, seeds: &[u64]) -> Result<Rollout<()>, EnvironmentError> {
        let make = || Ok(Box::new(self.clone()) as Box<dyn Environment>);
        Rollout::new(make, (size, 1), seeds, |_| ())
    }
}

type Played = (EpisodeScore, Option<Episode>);

impl Environment for Robot {
    fn name(&self) -> &str {
        "robot"
    }

    fn reset(&mut self, seed: u64) -> Result<(), EnvironmentError> {
        self.state = [seed as f64, self.start];
        Ok(())
    }

    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        self.state[1] += 1.0;
        (self.rules)(&mut self.state, action[0])
    }

    fn observation(&self) -> &[f64] {
        &self.state
    }

    fn score(&mut self, episode_return: f64) -> Result<f64, EnvironmentError> {
        Ok(episode_return * self.score)
    }
}

fn step(reward: f64, terminated: bool, truncated: bool) -> Step {
    let (intervention, clipped) = (None, None);
    Step { reward, terminated, truncated, intervention, clipped }
}

/// Pays the number of steps, of which there are four; in the third, another reward.
fn counter(third_reward: f64, score: f64) -> Robot {
    let rules = move |[_, steps]: &mut [f64; 2], _| {
        let reward = if *steps == 3.0 { third_reward } else { *steps };
        Ok(step(reward, *steps == 4.0, false))
    };
    let mut robot = Robot::new(rules);
    robot.score = score;
    robot
}

#[test]
fn any_environment_has_its_own_scores_and_errors() {
    let counter = counter(3.0, 0.1);
    let played = counter.play(&[7, 8], false).unwrap();
    for ((episode, _), seed) in played.into_iter().zip([7, 8]) {
        assert_eq!((episode.seed, episode.length), (seed, 4));
        assert_eq!((episode.episode_return, episode.score), (10.0, 1.0));
    }
    let mut other_size = counter.rollout(3, &[7]).unwrap();
    let error = other_size.step(|_, _, _| Ok::<_, EnvironmentError>(())).unwrap_err();
    assert_eq!(error.to_string(), "an observation has 2 numbers, but the policy takes 3");
    let breaks = Robot::new(|[_, steps], _| match *steps {
        3.0 => {
            let (name, reason) = ("robot".to_owned(), "a cable is loose".to_owned());
            Err(EnvironmentError::Failed { name, reason })
        }
        _ => Ok(Step::default()),
    });
    assert_eq!(breaks.problem(false), "the environment \"robot\" failed: a cable is loose");
}

/// A robot that ends after as many steps as its seed: terminates with seed 1, is truncated with 2,
/// both with 3. A person takes the second step; the third action is clipped.
#[test]
fn a_recorded_episode_is_what_was_observed_and_done() {
    let robot = Robot::new(|[seed, steps], action| {
        let [terminates, is_truncated] = [2.0, 1.0].map(|other| steps == seed && *seed != other);
        let mut step = step(*steps / 4.0, terminates, is_truncated);
        step.intervention = (*steps == 2.0).then(|| vec![action + 90.0]);
        step.clipped = (*steps == 3.0).then(|| vec![1.0]);
        Ok(step)
    });
    let play = |seeds: &[u64]| {
        let played = robot.play(seeds, true).unwrap().into_iter();
        Vec::from_iter(played.map(|(_, episode)| episode.unwrap()))
    };
    let together = play(&[3, 1, 2]);
    for (episode, (seed, observed, actions, person)) in together.iter().zip([
        (3, &[3., 0., 3., 1., 3., 2., 3., 3.][..], &[30., 121., 1.][..], &[1][..]),
        (1, &[1., 0., 1., 1.], &[10.], &[]),
        (2, &[2., 0., 2., 1., 2., 2.], &[20., 111.], &[1]),
    ]) {
        let weights = Hash::new(b"weights");
        assert_eq!((episode.step, episode.weights, episode.terminated), (70, weights, seed != 2));
        assert_eq!((&episode.observations[..], &episode.actions[..]), (observed, actions));
        assert_eq!(episode.rewards, [0.25, 0.5, 0.75][..seed as usize]);
        assert_eq!(episode.interventions, person);
        let episode_return = [0.25, 0.75, 1.5][seed as usize - 1];
        let score =
            EpisodeScore { seed, episode_return, length: seed as u32, score: episode_return };
        assert_eq!(episode.score, score);
        assert_eq!(play(&[seed])[0], *episode);
    }
    // A score is the policy's alone.
    let scored = robot.play(&[3], false);
    assert!(matches!(scored, Err(EnvironmentError::Intervention(3))));
    let endless = &play(&[u64::MAX])[0];
    assert_eq!((endless.rewards.len(), endless.terminated), (Episode::LONGEST, false));
}

/// A learner would refuse them.
#[test]
fn returns_and_scores_that_do_not_count_are_errors_as_soon_as_they_are_known() {
    for (reward, score, what, value, steps) in [
        (f64::NAN, 0.1, "return", "NaN", 3),
        (f64::NEG_INFINITY, 0.1, "return", "-inf", 3),
        (2e12, 0.1, "return", "2000000000007", 4),
        (3.0, f64::NAN, "score", "NaN", 4),
        (3.0, -1e12, "score", "-10000000000000", 4),
    ] {
        let error = counter(reward, score).problem(false);
        let problem =
            format!("the {what} of the episode with seed 7 is {value} after {steps} steps");
        assert_eq!(error, format!("{problem}, not a finite number up to 1e12"));
    }
    let largest = counter(1e12 - 7.0, 1.0).play(&[7], false).unwrap();
    assert_eq!(largest[0].0.score, 1e12);
}

/// Pays and observes the number of steps; from step `first` on it gives `value` in one of them.
fn diverging(first: u32, pays: bool, value: f64) -> Robot {
    let rules = move |[_, steps]: &mut [f64; 2], _| {
        let mut step = step(*steps, false, *steps == 9.0);
        match *steps >= f64::from(first) {
            true if pays => step.reward = value,
            true => *steps = value,
            false => {}
        }
        Ok(step)
    };
    let mut robot = Robot::new(rules);
    robot.start = if first == 0 { value } else { 0.0 };
    robot
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
        let played = diverging(3, pays, value).play(&[7], true).unwrap().remove(0);
        let episode = played.1.unwrap();
        assert_eq!(episode.observations, [7.0, 0.0, 7.0, 1.0, 7.0, 2.0]);
        assert_eq!((&*episode.rewards, episode.terminated), (&[1.0, 2.0][..], false));
        assert_eq!((episode.score.length, episode.score.episode_return), (2, 3.0));
        episode.verify().unwrap();

        let name = if pays { "reward[0]" } else { "observation[1]" };
        let error = diverging(1, pays, value).problem(true);
        let expected = format!("\"robot\" gave {name} = {value} after step 1 of the episode");
        assert!(error.contains(&expected), "{error}");
    }
    for (online, first) in [(true, 0), (false, 0), (false, 1), (false, 5)] {
        let error = diverging(first, false, f64::NAN).problem(online);
        let expected =
            format!("observation[1] = NaN after step {first} of the episode with seed 7");
        assert!(error.contains(&expected), "{error}");
    }
}
