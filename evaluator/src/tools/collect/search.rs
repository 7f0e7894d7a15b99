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

/// The searches take no more steps for more transitions: with these most of them move well, after a
/// minute on two cores.
const MOST_TRANSITIONS: u64 = 100_000;

/// Trains for as many steps as the recipe has for `transitions`. Returns the policies of all
/// iterations; `random` makes a generator for each search.
pub fn train(
    spec: &'static EnvironmentSpec,
    recipe: &Recipe,
    transitions: usize,
    random: impl Fn(u64) -> ChaCha8Rng,
) -> Result<Vec<LinearPolicy>, EnvironmentError> {
    let mut policies = Vec::new();
    let progress = ProgressBar::of("steps of training");
    let steps = recipe.steps_per_transition * (transitions as u64).min(MOST_TRANSITIONS);
    let of_each = steps / recipe.searches;
    progress.start(0, recipe.searches * of_each);
    for index in 0..recipe.searches {
        let mut search = Search::new(spec, random(index))?;
        search.run(of_each, |steps| progress.advance(index * of_each + steps));
        let score = spec.normalized_score(search.recent_return());
        let steps = search.environment_steps;
        let number = format!("search {} of {}", index + 1, recipe.searches);
        progress
            .say(&format!("training, {number}: normalized score {score:.1} after {steps} steps"));
        policies.extend(search.policies);
    }
    Ok(policies)
}

/// A search and its policies so far.
struct Search {
    policy: LinearPolicy,
    /// The policies of all iterations; the first never moves.
    policies: Vec<LinearPolicy>,
    /// Mean return of each iteration's trials.
    returns: Vec<f64>,
    moments: Moments,
    random: ChaCha8Rng,
    trials: Vec<Trial>,
    environment_steps: u64,
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
    /// Starts from the policy that never moves.
    fn new(spec: &'static EnvironmentSpec, random: ChaCha8Rng) -> Result<Self, EnvironmentError> {
        let policy = LinearPolicy::zero(spec.observation_dim, spec.action_dim);
        let trial = |_| {
            Ok(Trial {
                environment: sim::make(spec, 0)?,
                policy: policy.clone(),
                action: vec![0.0; spec.action_dim],
                moments: Moments::new(spec.observation_dim),
                shaped_return: 0.0,
                episode_return: 0.0,
                steps: 0,
            })
        };
        let trials = (0..2 * DIRECTIONS).map(trial).collect::<Result<_, EnvironmentError>>()?;
        Ok(Self {
            policies: vec![policy.clone()],
            returns: Vec::new(),
            policy,
            moments: Moments::new(spec.observation_dim),
            random,
            trials,
            environment_steps: 0,
        })
    }

    /// Iterates until it has taken `environment_steps`, to the end of the last iteration; calls
    /// `advance` with the number taken.
    fn run(&mut self, environment_steps: u64, advance: impl Fn(u64)) {
        while self.environment_steps < environment_steps {
            self.iterate();
            advance(self.environment_steps);
        }
    }

    /// Mean return of the trials of the last few iterations.
    fn recent_return(&self) -> f64 {
        let recent = &self.returns[self.returns.len().saturating_sub(5)..];
        recent.iter().sum::<f64>() / recent.len().max(1) as f64
    }

    /// One iteration.
    ///
    /// Trials run in parallel, but the search draws random numbers and sums results in the order of
    /// the trials, so the result does not depend on the number of threads.
    fn iterate(&mut self) {
        let normal = StandardNormal;
        let directions: Vec<Vec<f64>> = (0..DIRECTIONS)
            .map(|_| {
                (0..self.policy.weights.len()).map(|_| normal.sample(&mut self.random)).collect()
            })
            .collect();
        let seeds: Vec<u64> = (0..self.trials.len()).map(|_| self.random.random()).collect();

        for (trial, (direction, sign)) in self
            .trials
            .iter_mut()
            .zip(directions.iter().flat_map(|direction| [(direction, 1.0), (direction, -1.0)]))
        {
            trial.policy.normalizer = self.policy.normalizer.clone();
            for ((weight, center), delta) in
                trial.policy.weights.iter_mut().zip(&self.policy.weights).zip(direction)
            {
                *weight = center + sign * PERTURBATION * delta;
            }
        }
        self.trials
            .par_iter_mut()
            .zip(&seeds)
            .with_max_len(1)
            .for_each(|(trial, &seed)| trial.run(seed));
        for trial in &self.trials {
            self.moments.merge(&trial.moments);
            self.environment_steps += trial.steps;
        }

        let mut pairs: Vec<(f64, f64, &Vec<f64>)> = self
            .trials
            .chunks_exact(2)
            .zip(&directions)
            .map(|(pair, direction)| (pair[0].shaped_return, pair[1].shaped_return, direction))
            .collect();
        pairs.sort_by(|a, b| b.0.max(b.1).total_cmp(&a.0.max(a.1)));
        pairs.truncate(BEST);
        let returns: Vec<f64> = pairs.iter().flat_map(|pair| [pair.0, pair.1]).collect();
        let mean = returns.iter().sum::<f64>() / returns.len() as f64;
        let variance =
            returns.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / returns.len() as f64;
        let rate = STEP_SIZE / (BEST as f64 * variance.sqrt().max(1e-6));
        for (forwards, backwards, direction) in pairs {
            for (weight, delta) in self.policy.weights.iter_mut().zip(direction) {
                *weight += rate * (forwards - backwards) * delta;
            }
        }
        self.policy.normalizer = self.moments.normalizer();
        self.policies.push(self.policy.clone());
        self.returns.push(
            self.trials.iter().map(|trial| trial.episode_return).sum::<f64>()
                / self.trials.len() as f64,
        );
    }
}

impl Trial {
    fn run(&mut self, seed: u64) {
        self.moments.clear();
        (self.shaped_return, self.episode_return, self.steps) = (0.0, 0.0, 0);
        self.environment.reset(seed);
        loop {
            self.moments.push(self.environment.observation());
            self.policy.act(self.environment.observation(), &mut self.action);
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
