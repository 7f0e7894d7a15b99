//! Augmented random search: learns behavior in seconds, without a gradient.
//!
//! ARS V2-t of Mania, Guy and Recht, "Simple random search of static linear policies is competitive
//! for reinforcement learning" (2018). It perturbs the weights of a linear policy in random
//! directions, forwards and backwards, and moves along the better directions by how much better
//! they are. It normalizes observations by all that it has seen, and leaves the bonus for being
//! alive out of the objective, in which standing still would be a local optimum.

use quad_dataset::{EnvironmentSpec, Recipe};
use quad_runtime::ProgressBar;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::linear::{LinearPolicy, Moments};
use crate::sim::{self, EnvironmentError, Simulation};

/// N: directions tried in one iteration, each forwards and backwards.
const DIRECTIONS: usize = 8;
/// b: the directions used, ordered by the better of their two returns.
const BEST: usize = 4;
/// ν: how far the weights are perturbed.
const PERTURBATION: f64 = 0.025;
/// α: length of a step.
const STEP_SIZE: f64 = 0.02;
/// Subtracted from each step's reward.
const ALIVE_BONUS: f64 = 1.0;

/// Transitions beyond which the searches take no more steps: after a minute on two cores, most of
/// them move well.
const MAX_TRANSITIONS: u64 = 100_000;

/// Trains for as many steps as the recipe has for `transitions`. Returns the policies of all
/// iterations; `random` makes a generator for each search.
pub fn train(
    spec: &'static EnvironmentSpec,
    recipe: &Recipe,
    transitions: usize,
    random: impl Fn(u64) -> ChaCha8Rng,
) -> Result<Vec<LinearPolicy>, EnvironmentError> {
    let mut policies = Vec::new();
    let progress = ProgressBar::new("steps of training");
    let searches = recipe.searches;
    let steps = recipe.steps_per_transition * (transitions as u64).min(MAX_TRANSITIONS) / searches;
    progress.start(0, searches * steps);
    for index in 0..searches {
        let mut search = Search::new(spec, random(index))?;
        while search.steps < steps {
            search.iterate();
            progress.advance(index * steps + search.steps.min(steps));
        }
        let score = spec.normalized_score(search.mean_return);
        progress.say(&format!(
            "training, search {} of {searches}: normalized score {score:.1} after {} steps",
            index + 1,
            search.steps
        ));
        policies.extend(search.policies);
    }
    Ok(policies)
}

struct Search {
    policy: LinearPolicy,
    /// The policies of all iterations; the first never moves.
    policies: Vec<LinearPolicy>,
    /// Mean over the last iteration's trials.
    mean_return: f64,
    moments: Moments,
    random: ChaCha8Rng,
    trials: Vec<Trial>,
    steps: u64,
}

/// One perturbed policy and its environment.
struct Trial {
    environment: Simulation,
    policy: LinearPolicy,
    action: Vec<f32>,
    moments: Moments,
    shaped_return: f64,
    episode_return: f64,
    steps: u64,
}

impl Search {
    fn new(spec: &'static EnvironmentSpec, random: ChaCha8Rng) -> Result<Self, EnvironmentError> {
        let policy = LinearPolicy::zero(spec.observation_dim, spec.action_dim);
        let moments = Moments::new(spec.observation_dim);
        let trial = |_| {
            Ok(Trial {
                environment: sim::make(spec, 0)?,
                policy: policy.clone(),
                action: vec![0.0; spec.action_dim],
                moments: moments.clone(),
                shaped_return: 0.0,
                episode_return: 0.0,
                steps: 0,
            })
        };
        let trials = (0..2 * DIRECTIONS).map(trial);
        Ok(Self {
            trials: trials.collect::<Result<_, EnvironmentError>>()?,
            policies: vec![policy.clone()],
            mean_return: 0.0,
            policy,
            moments,
            random,
            steps: 0,
        })
    }

    /// Runs one iteration.
    ///
    /// Trials run in parallel, but the search draws random numbers and sums results in the order of
    /// the trials, so the result does not depend on the number of threads.
    fn iterate(&mut self) {
        let size = self.policy.weights.len();
        let mut direction = || {
            let normal = StandardNormal.sample_iter(&mut self.random);
            Vec::<f64>::from_iter(normal.take(size))
        };
        let directions = Vec::from_iter((0..DIRECTIONS).map(|_| direction()));
        let seeds: Vec<u64> = self.trials.iter().map(|_| self.random.random()).collect();

        let both = |direction| [(direction, 1.0), (direction, -1.0)];
        let signed = directions.iter().flat_map(both);
        for (trial, (direction, sign)) in self.trials.iter_mut().zip(signed) {
            trial.policy.normalizer = self.policy.normalizer.clone();
            let centers = self.policy.weights.iter().zip(direction);
            for (weight, (center, delta)) in trial.policy.weights.iter_mut().zip(centers) {
                *weight = center + sign * PERTURBATION * delta;
            }
        }
        let trials = self.trials.par_iter_mut().zip(seeds).with_max_len(1);
        trials.for_each(|(trial, seed)| trial.run(seed));
        for trial in &self.trials {
            self.moments.merge(&trial.moments);
            self.steps += trial.steps;
        }

        let pairs = self.trials.chunks_exact(2).zip(&directions);
        let mut pairs: Vec<(f64, f64, &Vec<f64>)> = pairs
            .map(|(pair, direction)| (pair[0].shaped_return, pair[1].shaped_return, direction))
            .collect();
        pairs.sort_by(|a, b| b.0.max(b.1).total_cmp(&a.0.max(a.1)));
        pairs.truncate(BEST);
        let returns: Vec<f64> = pairs.iter().flat_map(|pair| [pair.0, pair.1]).collect();
        let mean = returns.iter().sum::<f64>() / returns.len() as f64;
        let squares = returns.iter().map(|value| (value - mean).powi(2));
        let deviation = (squares.sum::<f64>() / returns.len() as f64).sqrt();
        let rate = STEP_SIZE / (BEST as f64 * deviation.max(1e-6));
        for (forwards, backwards, direction) in pairs {
            for (weight, delta) in self.policy.weights.iter_mut().zip(direction) {
                *weight += rate * (forwards - backwards) * delta;
            }
        }
        self.policy.normalizer = self.moments.normalizer();
        self.policies.push(self.policy.clone());
        let returns = self.trials.iter().map(|trial| trial.episode_return);
        self.mean_return = returns.sum::<f64>() / self.trials.len() as f64;
    }
}

impl Trial {
    fn run(&mut self, seed: u64) {
        self.moments = Moments::new(self.environment.observation().len());
        (self.shaped_return, self.episode_return, self.steps) = (0.0, 0.0, 0);
        self.environment.reset(seed);
        loop {
            let observation = self.environment.observation();
            self.moments.push(observation);
            self.policy.act(observation, &mut self.action);
            let step = self.environment.step(&self.action);
            self.shaped_return += step.reward - ALIVE_BONUS;
            self.episode_return += step.reward;
            self.steps += 1;
            if step.terminated || step.truncated {
                return;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use quad_dataset::environment::find;
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn a_search_learns_to_move() {
        let random = ChaCha8Rng::seed_from_u64(3);
        let mut search = Search::new(find("hopper").unwrap(), random).unwrap();
        let mut returns = Vec::new();
        while search.steps < 12_000 {
            search.iterate();
            returns.push(search.mean_return);
        }
        let quarter = returns.len() / 4;
        let mean = |returns: &[f64]| returns.iter().sum::<f64>() / returns.len() as f64;
        // The first policies hardly move.
        let (first, last) = (mean(&returns[..quarter]), mean(&returns[returns.len() - quarter..]));
        assert!(last > 2.0 * first, "{first}, then {last}");
    }
}
