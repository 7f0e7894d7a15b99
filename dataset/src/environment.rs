//! All that is known of an environment: the table `environments.toml`.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;

use crate::ogbench;
use crate::reward::RewardRule;
use crate::simulated::{Collect, Planar};

/// One environment. Sizes and reference returns are what data is read by; the rest is how
/// evaluators simulate it.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentSpec {
    /// Name used on command lines, in files and on the wire.
    pub name: String,
    #[serde(default)]
    simulation: Option<String>,
    /// What Gymnasium calls it, if it has the same simulation.
    #[serde(default)]
    pub gymnasium: Vec<String>,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action, each within ±1.
    pub action_dim: usize,
    /// Numbers in MuJoCo's `qpos`.
    pub qpos_dim: usize,
    /// Numbers in MuJoCo's `qvel`.
    pub qvel_dim: usize,
    /// Steps after which an episode is cut off (a timeout, not a termination).
    pub max_episode_steps: usize,
    /// Undiscounted returns that score 0 (D4RL's random policy) and 100 (D4RL's expert).
    reference_returns: (f64, f64),
    /// How a dataset's rewards are scaled before training, unless a task or an algorithm says
    /// otherwise.
    pub reward: RewardRule,
    /// When the goal is drawn, if there is one.
    #[serde(default)]
    pub goal: Option<Goal>,
    /// The robot, if it is one in a vertical plane.
    #[serde(default)]
    pub planar: Option<Planar>,
    /// The maze, if it is an ant or a ball in one: rows of cells along +y, in them cells along +x
    /// (1 wall, 0 free, R start, G goal).
    #[serde(default)]
    pub maze: Option<Vec<String>>,
    /// The environment whose row has its maze, if its own has not.
    #[serde(default)]
    maze_of: Option<String>,
    /// How a dataset is recorded in it, or why none can be.
    pub collect: Collect,
}

/// When an environment with a goal draws it anew.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Goal {
    /// Once, when the environment is made (D4RL's AntMaze v0 and v1).
    EachInstance,
    /// The goal is drawn at each reset (D4RL's AntMaze v2).
    EachEpisode,
    /// Never: the task, which the environment's name says, has one ([`ogbench::maze_task`]).
    OfTask,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    environment: Vec<EnvironmentSpec>,
}

#[allow(clippy::expect_used)] // The table is part of the program; the first test here reads it.
static ENVIRONMENTS: LazyLock<Vec<EnvironmentSpec>> = LazyLock::new(|| {
    let table: Table =
        toml::from_str(include_str!("../environments.toml")).expect("the embedded table is valid");
    let mut rows = table.environment;
    let maze = |row: &EnvironmentSpec| Some((row.name.clone(), row.maze.clone()?));
    let mazes: BTreeMap<_, _> = rows.iter().filter_map(maze).collect();
    for row in &mut rows {
        if let Some(other) = &row.maze_of {
            row.maze = mazes.get(other).cloned();
        }
    }
    rows.into_iter().flat_map(EnvironmentSpec::with_tasks).collect()
});

/// All environments of the table.
pub fn all() -> &'static [EnvironmentSpec] {
    &ENVIRONMENTS
}

/// The name of no environment.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("unknown environment `{name}`; known: {}", names().join(", "))]
pub struct UnknownEnvironment {
    /// What was asked for.
    pub name: String,
}

/// The names of all environments, in the order of the table.
pub fn names() -> Vec<&'static str> {
    all().iter().map(|environment| environment.name.as_str()).collect()
}

/// The environment of that name.
pub fn find(name: &str) -> Result<&'static EnvironmentSpec, UnknownEnvironment> {
    all()
        .iter()
        .find(|environment| environment.name == name)
        .ok_or_else(|| UnknownEnvironment { name: name.to_owned() })
}

/// The environment whose simulation Gymnasium has under that id, such as `Hopper-v5`.
pub(crate) fn find_gymnasium(id: &str) -> Option<&'static EnvironmentSpec> {
    all().iter().find(|environment| environment.gymnasium.iter().any(|known| known == id))
}

/// Name of the physics of an environment, known here or not.
pub fn simulation_of(name: &str) -> String {
    match find(name) {
        Ok(spec) => spec.simulation().to_owned(),
        Err(_) => ogbench::default_task(name).unwrap_or_else(|| name.to_owned()),
    }
}

impl EnvironmentSpec {
    /// The row and, where it stands for several tasks, one for each.
    fn with_tasks(self) -> Vec<Self> {
        let Some(place) =
            self.name.strip_suffix("-singletask-v0").filter(|_| self.goal == Some(Goal::OfTask))
        else {
            return vec![self];
        };
        let task = |name: String| match name == self.name {
            true => self.clone(),
            false => Self { simulation: Some(self.name.clone()), maze: None, name, ..self.clone() },
        };
        ogbench::endings().map(|ending| task(format!("{place}{ending}"))).collect()
    }

    /// Name of the physics, which several environments may share.
    pub fn simulation(&self) -> &str {
        self.simulation.as_deref().unwrap_or(&self.name)
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
        assert!(all().len() >= 6);
        for spec in all() {
            assert_eq!(find(&spec.name), Ok(spec), "names are unique");
            let physics = find(spec.simulation()).unwrap();
            let sizes = |spec: &EnvironmentSpec| {
                (spec.observation_dim, spec.action_dim, spec.qpos_dim, spec.qvel_dim)
            };
            assert_eq!(sizes(spec), sizes(physics), "{}", spec.name);
            assert!(spec.reference_returns.1 > spec.reference_returns.0, "{}", spec.name);
            assert!(
                physics.planar.is_some() != physics.maze.is_some(),
                "{}: one kind of simulation",
                spec.name
            );
            assert_eq!(
                physics.maze.is_some(),
                spec.goal.is_some(),
                "{}: a maze has a goal",
                spec.name
            );
            let is_free = |[x, y]: [f64; 2]| {
                let rows = physics.maze.as_ref().unwrap();
                rows[(y / 4.0) as usize + 1].as_bytes()[(x / 4.0) as usize + 1] == b'0'
            };
            let task = ogbench::maze_task(&spec.name);
            assert_eq!(task.is_some(), spec.goal == Some(Goal::OfTask), "{}", spec.name);
            assert!(
                task.is_none_or(|task| is_free(task.start) && is_free(task.goal)),
                "{}",
                spec.name
            );
            match &spec.collect {
                Collect::None(reason) => {
                    assert!(!reason.is_empty(), "{}: no recipe and no reason", spec.name)
                }
                Collect::Recipe(recipe) => {
                    let (bounds, shares): (Vec<f64>, Vec<f64>) =
                        recipe.mixture.iter().copied().unzip();
                    assert!(
                        bounds.is_sorted() && bounds[0] == f64::NEG_INFINITY,
                        "{}: {bounds:?}",
                        spec.name
                    );
                    assert!(
                        (shares.iter().sum::<f64>() - 1.0).abs() < 1e-9,
                        "{}: {shares:?}",
                        spec.name
                    );
                    assert!(
                        recipe.searches > 0 && recipe.steps_per_transition > 0,
                        "{}",
                        spec.name
                    );
                }
            }
        }
    }
}
