//! Tables of D4RL and OGBench, from `benchmarks.toml`.

use std::collections::BTreeMap;
use std::iter;
use std::sync::LazyLock;

use serde::Deserialize;

use super::maze::{CELL, GoalDraw, Judged, MazeTask};
use super::reward::RewardRule;
use super::simulator::{Robot, Simulator};

/// Row of `benchmarks.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Benchmark {
    /// Name in tables and messages, such as `OGBench`.
    pub name: String,
    /// Format of the files.
    pub format: Format,
    /// Default download folder.
    pub cache: Cache,
    /// Source argument of `quad-convert` for tasks without a dataset.
    pub converter: Option<String>,
    pub(super) host: Option<Host>,
    names: Templates,
    rules: Rules,
    tasks_per_place: Option<usize>,
    #[serde(default)]
    cells: BTreeMap<String, Vec<(Cell, Cell)>>,
    #[serde(default)]
    family: Vec<Family>,
}

/// File format of a benchmark.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// HDF5, as in D4RL.
    Hdf5,
    /// NumPy's npz, as in OGBench.
    Npz,
}

impl Format {
    /// Format of a file with these first bytes.
    pub fn from_start(start: &[u8]) -> Option<Self> {
        match start {
            [0x89, b'H', b'D', b'F', b'\r', b'\n', 0x1a, b'\n', ..] => Some(Self::Hdf5),
            [b'P', b'K', ..] => Some(Self::Npz),
            _ => None,
        }
    }

    /// Name in messages, such as `npz archive`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Hdf5 => "HDF5 file",
            Self::Npz => "npz archive",
        }
    }

    pub(super) fn extension(self) -> &'static str {
        match self {
            Self::Hdf5 => "hdf5",
            Self::Npz => "npz",
        }
    }
}

/// Default download folder of a benchmark's own library.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cache {
    /// Path in the home folder.
    pub folder: String,
    /// Environment variable that overrides the folder.
    pub variable: Option<String>,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Host {
    pub license: String,
    pub folders: Vec<String>,
}

/// Templates with placeholders {place}, {data} and {task}.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Templates {
    environment: String,
    task: Option<String>,
    dataset: Option<String>,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Rules {
    reward: RewardRule,
    judged: Judged,
    start_noise: Option<f64>,
    #[serde(default)]
    relabel: bool,
}

type Cell = [u8; 2];

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Family {
    robot: Option<String>,
    #[serde(default)]
    goal: GoalDraw,
    #[serde(default)]
    reach: f64,
    #[serde(default)]
    measured: usize,
    default_task: Option<usize>,
    places: Vec<Place>,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Place {
    name: String,
    maze: Option<String>,
    simulation: Option<String>,
    max_episode_steps: Option<usize>,
    #[serde(default)]
    data: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tables {
    robot: Vec<Robot>,
    maze: BTreeMap<String, Vec<String>>,
    benchmark: Vec<Benchmark>,
}

#[allow(clippy::expect_used)] // The table is part of the program; the test here reads it.
static TABLES: LazyLock<Tables> = LazyLock::new(|| {
    toml::from_str(include_str!("../../benchmarks.toml")).expect("the embedded table is valid")
});

/// All benchmarks.
pub fn list() -> &'static [Benchmark] {
    &TABLES.benchmark
}

/// Benchmark of the given name.
pub fn find(name: &str) -> Option<&'static Benchmark> {
    list().iter().find(|benchmark| benchmark.name == name)
}

pub(super) struct BenchmarkEnvironment {
    pub name: String,
    pub benchmark: &'static Benchmark,
    pub simulation: String,
    pub task: Option<MazeTask>,
    pub simulator: Option<Simulator>,
    pub max_episode_steps: usize,
    place: &'static Place,
    suffix: String,
}

static ENVIRONMENTS: LazyLock<Vec<BenchmarkEnvironment>> =
    LazyLock::new(|| list().iter().flat_map(Benchmark::environments).collect());

pub(super) fn environments() -> &'static [BenchmarkEnvironment] {
    &ENVIRONMENTS
}

pub(super) fn environment(name: &str) -> Option<&'static BenchmarkEnvironment> {
    let mut environments = environments().iter();
    environments.find(|environment| environment.name == name)
}

/// Task that labels an environment's datasets with rewards, if they have none.
pub fn relabeling(environment: &str) -> Option<MazeTask> {
    let environment = self::environment(environment)?;
    let is_relabeled = environment.benchmark.rules.relabel;
    environment.task.filter(|_| is_relabeled)
}

impl Benchmark {
    fn environments(&'static self) -> impl Iterator<Item = BenchmarkEnvironment> {
        let places =
            |family: &'static Family| family.places.iter().map(move |place| (family, place));
        let places = self.family.iter().flat_map(places);
        places.flat_map(move |(family, place)| {
            let default = (family.default_task.unwrap_or(1), String::new());
            let numbers = 1..=self.tasks_per_place.unwrap_or(0);
            let tasks = numbers.map(|number| (number, format!("-task{number}")));
            let tasks = iter::once(default).chain(tasks);
            tasks.map(move |(number, suffix)| self.environment(family, place, number, suffix))
        })
    }

    fn environment(
        &'static self,
        family: &Family,
        place: &'static Place,
        number: usize,
        suffix: String,
    ) -> BenchmarkEnvironment {
        let name = |suffix| fill(&self.names.environment, &place.name, "", suffix);
        let maze_name = place.maze.as_deref();
        let cells = maze_name.and_then(|maze| self.cells.get(maze)?.get(number - 1));
        let center = |[row, column]: Cell| [column, row].map(|i| (f64::from(i) - 1.0) * CELL);
        let is_robot = |robot: &&Robot| Some(&robot.name) == family.robot.as_ref();
        let robot = TABLES.robot.iter().find(is_robot);
        let maze = robot.zip(maze_name.and_then(|maze| TABLES.maze.get(maze)));
        BenchmarkEnvironment {
            name: name(&suffix),
            benchmark: self,
            simulation: place.simulation.clone().unwrap_or_else(|| name("")),
            task: cells.map(|&(start, goal)| MazeTask {
                start: center(start),
                start_noise: self.rules.start_noise,
                goal: center(goal),
                draw: family.goal,
                reach: family.reach,
                judged: self.rules.judged,
                measured: family.measured,
            }),
            simulator: maze.map(|(robot, map)| Simulator::Maze(robot, map)),
            max_episode_steps: place.max_episode_steps.unwrap_or(1000),
            place,
            suffix,
        }
    }
}

impl BenchmarkEnvironment {
    /// Reward rule of the benchmark for tasks in mazes, else none.
    pub fn reward(&self) -> RewardRule {
        let reward = self.benchmark.rules.reward;
        self.task.map_or(RewardRule::AsIs, |_| reward)
    }

    /// The task on the place's dataset of this name.
    fn task(&self, data: &str) -> Option<BenchmarkTask> {
        let (names, place) = (&self.benchmark.names, &self.place.name);
        Some(BenchmarkTask {
            name: fill(names.task.as_ref()?, place, data, &self.suffix),
            benchmark: self.benchmark,
            environment: self.name.clone(),
            dataset: fill(names.dataset.as_ref()?, place, data, ""),
            maze: self.task,
            is_default: self.suffix.is_empty(),
        })
    }
}

fn fill(template: &str, place: &str, data: &str, task: &str) -> String {
    let name = template.replace("{place}", place).replace("{data}", data);
    name.replace("{task}", task)
}

/// Task with its environment and dataset.
pub struct BenchmarkTask {
    /// Name after `--task`.
    pub name: String,
    /// Benchmark of the task.
    pub benchmark: &'static Benchmark,
    /// Name after `--env`.
    pub environment: String,
    /// Name after `--dataset`.
    pub dataset: String,
    /// Task that labels the dataset with rewards, if it has none.
    pub maze: Option<MazeTask>,
    /// True for the default task of the dataset.
    pub is_default: bool,
}

/// All tasks named by a rule, grouped by dataset.
pub fn tasks() -> impl Iterator<Item = BenchmarkTask> {
    let places = environments().chunk_by(|one, other| std::ptr::eq(one.place, other.place));
    places.flat_map(|place| {
        let datasets = place[0].place.data.iter();
        datasets.flat_map(move |data| place.iter().filter_map(move |one| one.task(data)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_become_tasks() {
        for (place, task, start, goal, reach, measured) in [
            ("antmaze-large", "", [0.0, 0.0], [36.0, 24.0], 0.5, 0),
            ("antmaze-giant", "-task4", [8.0, 28.0], [44.0, 16.0], 0.5, 0),
            ("pointmaze-large", "-task4", [28.0, 8.0], [12.0, 16.0], 1.0, 0),
            ("antsoccer-arena", "", [20.0, 20.0], [0.0, 20.0], 0.5, 15),
        ] {
            let name = format!("{place}-singletask{task}-v0");
            let task = relabeling(&name).unwrap();
            assert_eq!((task.start, task.goal), (start, goal), "{name}");
            assert_eq!((task.reach, task.measured), (reach, measured));
        }
        for name in [
            "antmaze-large-singletask-task6-v0",
            "antmaze-large-singletask-task0-v0",
            "antmaze-large",
            "cube-single-singletask-v0",
        ] {
            assert_eq!(relabeling(name), None, "{name}");
        }
        for environment in environments() {
            let rules = &environment.benchmark.rules;
            // Labels are of the state before a step.
            assert!(!rules.relabel || rules.judged == Judged::BeforeStep);
            let (Some(task), Some(Simulator::Maze(_, map))) =
                (environment.task, environment.simulator.clone())
            else {
                continue;
            };
            let is_free = |[x, y]: [f64; 2]| {
                map[(y / CELL) as usize + 1].as_bytes()[(x / CELL) as usize + 1] == b'0'
            };
            let name = &environment.name;
            assert!(is_free(task.start) && is_free(task.goal), "{name}");
        }
    }

    #[test]
    fn tasks_and_datasets_are_those_that_are_published() {
        let tasks = Vec::from_iter(tasks());
        assert_eq!(tasks.len(), 42 * 6);
        let names = [37, 251].map(|number| {
            let task: &BenchmarkTask = &tasks[number];
            [&*task.name, &task.environment, &task.dataset].join(" ")
        });
        let medium = "antmaze-medium-navigate-singletask-task1-v0 antmaze-medium-singletask-task1-v0 antmaze-medium-navigate-v0";
        let noisy = "puzzle-4x6-noisy-singletask-task5-v0 puzzle-4x6-singletask-task5-v0 puzzle-4x6-noisy-v0";
        assert_eq!(names, [medium, noisy]);
        let unpublished = "antmaze-giant-explore-singletask-v0";
        assert!(tasks.iter().all(|task| task.name != unpublished));
    }
}
