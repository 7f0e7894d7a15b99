//! Simulated environments: `environments.toml`, and the mazes of [`benchmarks`].

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;

use super::benchmarks::{self, BenchmarkEnvironment};
use super::maze::MazeTask;
use super::reward::RewardRule;
use super::simulator::{Recipe, Simulator};

/// Simulated environment.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSpec {
    /// Name on command lines, in files and in messages.
    pub name: String,
    simulation: Option<String>,
    /// Gymnasium ids of the same environment.
    #[serde(default)]
    pub gymnasium: Vec<String>,
    /// Dimension of an observation.
    pub observation_dim: usize,
    /// Dimension of an action; each component is within ±1.
    pub action_dim: usize,
    /// Length of MuJoCo's `qpos`.
    pub qpos_dim: usize,
    /// Length of MuJoCo's `qvel`.
    pub qvel_dim: usize,
    /// Time limit in steps (a timeout, not a termination).
    pub max_episode_steps: usize,
    /// Undiscounted returns of D4RL's random policy (score 0) and expert (score 100).
    reference_returns: (f64, f64),
    /// Reward rule, unless a task or an algorithm overrides it.
    pub reward: RewardRule,
    /// Task, if the environment is a maze.
    #[serde(skip)]
    pub maze: Option<MazeTask>,
    /// Robot and its surroundings.
    pub simulator: Simulator,
    /// Recipe for recording a dataset, if any.
    pub collect: Option<Recipe>,
    /// D4RL's files, if it has some.
    pub d4rl: Option<D4rl>,
}

/// The policies of D4RL's files, and the files' mean normalized scores.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case")]
#[allow(missing_docs)] // The names say it.
pub struct D4rl {
    /// Epoch, from 0, of the policy that is medium.
    pub epoch: u64,
    pub medium: f64,
    pub medium_replay: f64,
    pub expert: f64,
}

#[allow(clippy::expect_used)] // The table is part of the program; the first test here reads it.
static ENVIRONMENTS: LazyLock<Vec<EnvironmentSpec>> = LazyLock::new(|| {
    let table: BTreeMap<String, Vec<EnvironmentSpec>> =
        toml::from_str(include_str!("../../environments.toml"))
            .expect("the embedded table is valid");
    let mazes = benchmarks::environments().iter();
    let mazes = mazes.filter_map(EnvironmentSpec::from_maze);
    table.into_values().flatten().chain(mazes).collect()
});

/// All environments.
pub fn specs() -> &'static [EnvironmentSpec] {
    &ENVIRONMENTS
}

/// Error for an unknown environment. Its text has one environment for each simulation.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("unknown environment `{name}`; known: {}, and their other tasks", simulations().join(", "))]
pub struct UnknownEnvironment {
    /// Unknown name.
    pub name: String,
}

/// Names of all environments.
pub fn names() -> Vec<&'static str> {
    specs().iter().map(|spec| spec.name.as_str()).collect()
}

fn simulations() -> Vec<&'static str> {
    let own = specs().iter().filter(|spec| spec.simulation() == spec.name);
    own.map(|spec| spec.name.as_str()).collect()
}

/// Environment of the given name.
pub fn find(name: &str) -> Result<&'static EnvironmentSpec, UnknownEnvironment> {
    let name = name.to_owned();
    let spec = specs().iter().find(|spec| spec.name == name);
    spec.ok_or(UnknownEnvironment { name })
}

/// Environment of a Gymnasium id such as `Hopper-v5`.
pub(crate) fn find_gymnasium(id: &str) -> Option<&'static EnvironmentSpec> {
    let has_id = |spec: &&EnvironmentSpec| spec.gymnasium.iter().any(|other| other == id);
    specs().iter().find(has_id)
}

/// Name of an environment's physics, simulated here or not.
pub fn simulation_name(name: &str) -> String {
    match (find(name), benchmarks::environment(name)) {
        (Ok(spec), _) => spec.simulation().to_owned(),
        (_, Some(environment)) => environment.simulation.clone(),
        _ => name.to_owned(),
    }
}

/// Reward rule for an environment's datasets, simulated here or not.
pub fn reward_rule(name: &str) -> RewardRule {
    match (find(name), benchmarks::environment(name)) {
        (Ok(spec), _) => spec.reward,
        (_, Some(environment)) => environment.reward(),
        _ => RewardRule::AsIs,
    }
}

impl EnvironmentSpec {
    fn from_maze(environment: &BenchmarkEnvironment) -> Option<Self> {
        let simulator = environment.simulator.clone()?;
        let Simulator::Maze(robot, _) = simulator else { return None };
        Some(Self {
            name: environment.name.clone(),
            simulation: Some(environment.simulation.clone()),
            gymnasium: Vec::new(),
            observation_dim: robot.observation_dim,
            action_dim: robot.action_dim,
            qpos_dim: robot.qpos_dim,
            qvel_dim: robot.qvel_dim,
            max_episode_steps: environment.max_episode_steps,
            reference_returns: (0.0, 1.0),
            reward: environment.reward(),
            maze: Some(environment.task?),
            simulator,
            collect: None,
            d4rl: None,
        })
    }

    /// Name of the physics, shared by several environments.
    pub fn simulation(&self) -> &str {
        self.simulation.as_deref().unwrap_or(&self.name)
    }

    /// Lengths of an observation and of an action.
    pub fn sizes(&self) -> (usize, usize) {
        (self.observation_dim, self.action_dim)
    }

    /// Another simulation with observations and actions of the same sizes.
    pub fn same_sized(&self) -> Option<&'static Self> {
        let mut alike = specs().iter().filter(|spec| spec.sizes() == self.sizes());
        alike.find(|spec| spec.simulation() != self.simulation())
    }

    /// D4RL's normalized score of an undiscounted return: `100 · (R - min) / (max - min)`.
    pub fn normalized_score(&self, episode_return: f64) -> f64 {
        let (min, max) = self.reference_returns;
        100.0 * (episode_return - min) / (max - min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_consistent() {
        assert_eq!(specs().len(), 3 * 2 + 3 * 2 + 6 * 6);
        for spec in specs() {
            let name = &spec.name;
            assert_eq!(find(name), Ok(spec), "names are unique");
            let physics = find(spec.simulation()).unwrap();
            assert_eq!(spec.qpos_dim, physics.qpos_dim, "{name}");
            assert!(spec.maze.is_none() || spec.simulator == physics.simulator, "{name}");
            let (min, max) = spec.reference_returns;
            assert!(max > min, "{name}");
        }
        for recipe in specs().iter().filter_map(|spec| spec.collect.as_ref()) {
            let (bounds, shares): (Vec<f64>, Vec<f64>) = recipe.mixture.iter().copied().unzip();
            assert!(bounds.is_sorted() && bounds[0] == f64::NEG_INFINITY);
            let whole: f64 = shares.iter().sum();
            assert!((whole - 1.0).abs() < 1e-9, "{shares:?}");
            assert!(recipe.searches.min(recipe.steps_per_transition) > 0);
        }
    }

    #[test]
    fn an_unknown_environment_is_told_with_few_others() {
        let told = find("my-robot").unwrap_err().to_string();
        for name in ["`my-robot`", "hopper", "antmaze-large,", "pointmaze-giant-"] {
            assert!(told.contains(name), "{told}");
        }
        assert!(!told.contains("task1") && told.len() < 400, "{told}");
    }
}
