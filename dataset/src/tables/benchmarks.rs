//! Tables of D4RL and OGBench, from `benchmarks.toml`.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::Deserialize;

use super::maze::{CELL, GoalDraw, Judged, MazeTask};
use super::reward::RewardRule;
use super::simulator::{Robot, Simulator};

/// Row of `benchmarks.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Benchmark {
    /// Display name.
    pub name: String,
    /// Format of the files.
    pub format: Format,
    /// Default download folder.
    pub cache: Cache,
    /// Source argument of `quad-convert` for tasks without a dataset.
    pub converter: Option<String>,
    host: Option<Host>,
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
    pub fn of(start: &[u8]) -> Option<Self> {
        match start {
            [0x89, b'H', b'D', b'F', b'\r', b'\n', 0x1a, b'\n', ..] => Some(Self::Hdf5),
            [b'P', b'K', ..] => Some(Self::Npz),
            _ => None,
        }
    }

    /// Display name.
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
pub(crate) struct Host {
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
    #[serde(default = "first")]
    default_task: usize,
    places: Vec<Place>,
}

fn first() -> usize {
    1
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Place {
    name: String,
    maze: Option<String>,
    simulation: Option<String>,
    #[serde(default = "thousand")]
    max_episode_steps: usize,
    #[serde(default)]
    data: Vec<String>,
}

fn thousand() -> usize {
    1000
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    robot: Vec<Robot>,
    maze: BTreeMap<String, Vec<String>>,
    benchmark: Vec<Benchmark>,
}

#[allow(clippy::expect_used)] // The table is part of the program; the test here reads it.
static TABLE: LazyLock<Table> = LazyLock::new(|| {
    toml::from_str(include_str!("../../benchmarks.toml")).expect("the embedded table is valid")
});

/// All benchmarks.
pub fn all() -> &'static [Benchmark] {
    &TABLE.benchmark
}

/// Benchmark of the given name.
pub fn find(name: &str) -> Option<&'static Benchmark> {
    all().iter().find(|benchmark| benchmark.name == name)
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
    LazyLock::new(|| all().iter().flat_map(Benchmark::environments).collect());

pub(super) fn environments() -> &'static [BenchmarkEnvironment] {
    &ENVIRONMENTS
}

pub(super) fn environment(name: &str) -> Option<&'static BenchmarkEnvironment> {
    environments().iter().find(|environment| environment.name == name)
}

/// Task that labels an environment's datasets with rewards, if they have none.
pub fn relabeling(environment: &str) -> Option<MazeTask> {
    self::environment(environment)
        .filter(|environment| environment.benchmark.rules.relabel)
        .and_then(|environment| environment.task)
}

impl Benchmark {
    fn environments(&'static self) -> impl Iterator<Item = BenchmarkEnvironment> {
        let places = self
            .family
            .iter()
            .flat_map(|family| family.places.iter().map(move |place| (family, place)));
        places.flat_map(move |(family, place)| {
            let numbered = (1..=self.tasks_per_place.unwrap_or(0))
                .map(|number| (number, format!("-task{number}")));
            let tasks = [(family.default_task, String::new())].into_iter().chain(numbered);
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
        let maze = place.maze.as_deref();
        let cells = maze.and_then(|maze| self.cells.get(maze)?.get(number - 1));
        let center = |[row, column]: Cell| [column, row].map(|i| (f64::from(i) - 1.0) * CELL);
        let robot = TABLE.robot.iter().find(|robot| Some(&robot.name) == family.robot.as_ref());
        let map = maze.and_then(|maze| TABLE.maze.get(maze));
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
            simulator: robot.zip(map).map(|(robot, map)| Simulator::Maze(robot, map)),
            max_episode_steps: place.max_episode_steps,
            place,
            suffix,
        }
    }

    pub(crate) fn host(&self) -> Option<&Host> {
        self.host.as_ref()
    }
}

impl BenchmarkEnvironment {
    /// Reward rule of the benchmark for tasks in mazes, else none.
    pub fn reward(&self) -> RewardRule {
        self.task.map_or(RewardRule::AsIs, |_| self.benchmark.rules.reward)
    }

    fn datasets(&self) -> impl Iterator<Item = (&'static str, String)> {
        let template = self.benchmark.names.dataset.as_deref();
        let kinds = template
            .into_iter()
            .flat_map(|template| self.place.data.iter().map(move |data| (template, &**data)));
        kinds.map(|(template, data)| (data, fill(template, &self.place.name, data, "")))
    }
}

fn fill(template: &str, place: &str, data: &str, task: &str) -> String {
    template.replace("{place}", place).replace("{data}", data).replace("{task}", task)
}

/// Task with its environment and dataset.
pub struct BenchmarkTask {
    /// Task name.
    pub name: String,
    /// Benchmark of the task.
    pub benchmark: &'static Benchmark,
    /// Environment name.
    pub environment: String,
    /// Dataset name.
    pub dataset: String,
    /// Task that labels the dataset with rewards, if it has none.
    pub maze: Option<MazeTask>,
    /// True for the default task of the dataset.
    pub is_default: bool,
}

/// All tasks named by a rule, grouped by dataset.
pub fn tasks() -> impl Iterator<Item = BenchmarkTask> {
    environments().chunk_by(|one, other| std::ptr::eq(one.place, other.place)).flat_map(|place| {
        place[0].datasets().flat_map(move |(data, dataset)| {
            place.iter().filter_map(move |environment| {
                let BenchmarkEnvironment { benchmark, place, suffix, task, .. } = environment;
                let template = benchmark.names.task.as_ref()?;
                Some(BenchmarkTask {
                    name: fill(template, &place.name, data, suffix),
                    benchmark,
                    environment: environment.name.clone(),
                    dataset: dataset.clone(),
                    maze: *task,
                    is_default: suffix.is_empty(),
                })
            })
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_become_tasks() {
        for (name, expected) in [
            ("antmaze-large-singletask-v0", Some(([0.0, 0.0], [36.0, 24.0], 0.5, 0))),
            ("antmaze-giant-singletask-task4-v0", Some(([8.0, 28.0], [44.0, 16.0], 0.5, 0))),
            ("pointmaze-large-singletask-task4-v0", Some(([28.0, 8.0], [12.0, 16.0], 1.0, 0))),
            ("humanoidmaze-medium-singletask-task3-v0", Some(([8.0, 16.0], [4.0, 12.0], 0.5, 0))),
            ("antsoccer-arena-singletask-v0", Some(([20.0, 20.0], [0.0, 20.0], 0.5, 15))),
            ("antmaze-large-singletask-task6-v0", None),
            ("antmaze-large-singletask-task0-v0", None),
            ("antmaze-large", None),
            ("cube-single-singletask-v0", None),
        ] {
            let found =
                relabeling(name).map(|task| (task.start, task.goal, task.reach, task.measured));
            assert_eq!(found, expected, "{name}");
        }
        for environment in environments() {
            let Rules { relabel, judged, .. } = environment.benchmark.rules;
            assert!(
                !relabel || judged == Judged::BeforeStep,
                "labels are of the state before a step"
            );
            let Some(task) = environment.task else { continue };
            let Some(Simulator::Maze(_, map)) = environment.simulator else { continue };
            let is_free = |[x, y]: [f64; 2]| {
                map[(y / CELL) as usize + 1].as_bytes()[(x / CELL) as usize + 1] == b'0'
            };
            assert!(is_free(task.start) && is_free(task.goal), "{}", environment.name);
        }
    }

    #[test]
    fn tasks_and_datasets_are_those_that_are_published() {
        let all = Vec::from_iter(tasks());
        assert_eq!(all.len(), 42 * 6);
        let names = |at: usize| (&*all[at].name, &*all[at].environment, &*all[at].dataset);
        let (task, environment) =
            ("antmaze-medium-navigate-singletask-task1-v0", "antmaze-medium-singletask-task1-v0");
        assert_eq!(names(36 + 1), (task, environment, "antmaze-medium-navigate-v0"));
        let (task, environment) =
            ("puzzle-4x6-noisy-singletask-task5-v0", "puzzle-4x6-singletask-task5-v0");
        assert_eq!(names(42 * 6 - 1), (task, environment, "puzzle-4x6-noisy-v0"));
        assert!(all.iter().all(|task| task.name != "antmaze-giant-explore-singletask-v0"));
    }
}
