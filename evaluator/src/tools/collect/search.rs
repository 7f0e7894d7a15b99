//! Augmented random search of linear policies: learns behavior in seconds, without a gradient.
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

/// a = M · (s - mean) / deviation. The environment clips it.
#[derive(Clone, Debug)]
pub struct LinearPolicy {
    /// M [action_dim, observation_dim].
    weights: Vec<f64>,
    mean: Vec<f64>,
    inverse_std: Vec<f64>,
}

impl LinearPolicy {
    fn zero(observation_dim: usize, action_dim: usize) -> Self {
        Self {
            weights: vec![0.0; action_dim * observation_dim],
            mean: vec![0.0; observation_dim],
            inverse_std: vec![1.0; observation_dim],
        }
    }

    /// Writes `action`.
    pub fn act(&self, observation: &[f64], action: &mut [f32]) {
        let rows = self.weights.chunks_exact(observation.len());
        for (value, row) in action.iter_mut().zip(rows) {
            let mut sum = 0.0;
            for (i, &observed) in observation.iter().enumerate() {
                sum += row[i] * (observed - self.mean[i]) * self.inverse_std[i];
            }
            *value = sum as f32;
        }
    }
}

/// Running mean and variance of observations, by Welford's recurrence; two merge by Chan's formula.
#[derive(Clone, Debug)]
struct Moments {
    count: f64,
    mean: Vec<f64>,
    /// Σ (s - mean)²
    squares: Vec<f64>,
}

impl Moments {
    fn new(observation_dim: usize) -> Self {
        let [mean, squares] = [(); 2].map(|_| vec![0.0; observation_dim]);
        Self { count: 0.0, mean, squares }
    }

    fn push(&mut self, observation: &[f64]) {
        self.count += 1.0;
        for (i, value) in observation.iter().enumerate() {
            let delta = value - self.mean[i];
            self.mean[i] += delta / self.count;
            self.squares[i] += delta * (value - self.mean[i]);
        }
    }

    fn merge(&mut self, other: &Self) {
        let count = self.count + other.count;
        if other.count == 0.0 {
            return;
        }
        for i in 0..self.mean.len() {
            let delta = other.mean[i] - self.mean[i];
            self.mean[i] += delta * other.count / count;
            self.squares[i] += other.squares[i] + delta * delta * self.count * other.count / count;
        }
        self.count = count;
    }

    /// The inverse standard deviations; 1 for a value that never changes, which is only centered.
    fn inverse_std(&self) -> Vec<f64> {
        let inverse = |squares: &f64| {
            let std = (squares / (self.count - 1.0).max(1.0)).sqrt();
            if std > 1e-7 { 1.0 / std } else { 1.0 }
        };
        self.squares.iter().map(inverse).collect()
    }
}

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
                moments: moments.clone(),
                shaped_return: 0.0,
                episode_return: 0.0,
                steps: 0,
            })
        };
        let trials = (0..2 * DIRECTIONS).map(trial).collect::<Result<_, EnvironmentError>>()?;
        let policies = vec![policy.clone()];
        Ok(Self { policy, policies, mean_return: 0.0, moments, random, trials, steps: 0 })
    }

    /// Runs one iteration.
    ///
    /// Trials run in parallel, but the search draws random numbers and sums results in the order of
    /// the trials, so the result does not depend on the number of threads.
    fn iterate(&mut self) {
        let size = self.policy.weights.len();
        let mut direction =
            |_| Vec::<f64>::from_iter(StandardNormal.sample_iter(&mut self.random).take(size));
        let directions = Vec::from_iter((0..DIRECTIONS).map(&mut direction));
        let seeds: Vec<u64> = self.trials.iter().map(|_| self.random.random()).collect();

        let signed = directions.iter().flat_map(|direction| [(direction, 1.0), (direction, -1.0)]);
        for (trial, (direction, sign)) in self.trials.iter_mut().zip(signed) {
            trial.policy.clone_from(&self.policy);
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
        self.policy.mean.clone_from(&self.moments.mean);
        self.policy.inverse_std = self.moments.inverse_std();
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
        let mut action = vec![0.0; self.environment.spec().action_dim];
        loop {
            let observation = self.environment.observation();
            self.moments.push(observation);
            self.policy.act(observation, &mut action);
            let step = self.environment.step(&action);
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

    #[test]
    fn merged_moments_are_those_of_all_observations() {
        let values = [[1.0, 5.0], [2.0, 5.0], [4.0, 5.0], [9.0, 5.0]];
        let moments = |values: &[[f64; 2]]| {
            let mut moments = Moments::new(2);
            values.iter().for_each(|value| moments.push(value));
            moments
        };
        let mut merged = moments(&values[..1]);
        merged.merge(&moments(&values[1..]));
        merged.merge(&moments(&[]));
        for moments in [moments(&values), merged] {
            assert_eq!(moments.mean, [4.0, 5.0]);
            // Variance 38 / 3; the second value never changed.
            let [varying, constant] = moments.inverse_std()[..] else { panic!() };
            assert!((varying - (3.0_f64 / 38.0).sqrt()).abs() < 1e-12 && constant == 1.0);
        }
    }
}
