//! OGBench's datasets, and what of them is a task, by their names.
//!
//! The task `antmaze-large-navigate-singletask-task1-v0` is to do what the environment
//! `antmaze-large-singletask-task1-v0` rewards, and to learn it from the dataset
//! `antmaze-large-navigate-v0`. Without `-task1` it is the default one of five.
//!
//! The datasets have no rewards. In a maze a task is to come to a place, so rewards and masks
//! follow from the observations; they are those of `relabel_dataset` in OGBench 1.2, which judges
//! the state before a step: the reward is 1 there and the mask 0, and else the other way round.
//! OGBench's reward is this one less 1 ([`RewardRule::Subtract1`](crate::RewardRule::Subtract1)).

use crate::catalog::NamedDataset;
use crate::recording::{Recording, RowKind};

const NAVIGATE: &[&str] = &["navigate", "stitch"];
const EXPLORE: &[&str] = &["navigate", "stitch", "explore"];
const PLAY: &[&str] = &["play", "noisy"];

/// Robots and places, and the kinds of data of each.
const DATASETS: [(&str, &[&str]); 20] = [
    ("pointmaze-medium", NAVIGATE),
    ("pointmaze-large", NAVIGATE),
    ("pointmaze-giant", NAVIGATE),
    ("antmaze-medium", EXPLORE),
    ("antmaze-large", EXPLORE),
    ("antmaze-giant", NAVIGATE),
    ("humanoidmaze-medium", NAVIGATE),
    ("humanoidmaze-large", NAVIGATE),
    ("humanoidmaze-giant", NAVIGATE),
    ("antsoccer-arena", NAVIGATE),
    ("antsoccer-medium", NAVIGATE),
    ("cube-single", PLAY),
    ("cube-double", PLAY),
    ("cube-triple", PLAY),
    ("cube-quadruple", PLAY),
    ("scene", PLAY),
    ("puzzle-3x3", PLAY),
    ("puzzle-4x4", PLAY),
    ("puzzle-4x5", PLAY),
    ("puzzle-4x6", PLAY),
];

/// Row and column of a maze's map.
type Cell = (u8, u8);

/// Start and goal of tasks 1 to 5, by how the name of the robot's place ends. In soccer it is the
/// ball that must come to the goal.
const TASKS: [(&str, [(Cell, Cell); 5]); 5] = [
    (
        "maze-medium",
        [((1, 1), (6, 6)), ((6, 1), (1, 6)), ((5, 3), (4, 2)), ((6, 5), (6, 1)), ((2, 6), (1, 1))],
    ),
    (
        "maze-large",
        [
            ((1, 1), (7, 10)),
            ((5, 4), (7, 1)),
            ((7, 4), (1, 10)),
            ((3, 8), (5, 4)),
            ((1, 1), (5, 4)),
        ],
    ),
    (
        "maze-giant",
        [
            ((1, 1), (10, 14)),
            ((1, 14), (10, 1)),
            ((8, 14), (1, 1)),
            ((8, 3), (5, 12)),
            ((5, 9), (3, 8)),
        ],
    ),
    (
        "soccer-arena",
        [((1, 6), (5, 2)), ((2, 2), (2, 2)), ((6, 1), (6, 6)), ((6, 6), (6, 1)), ((4, 6), (1, 6))],
    ),
    (
        "soccer-medium",
        [((1, 1), (6, 6)), ((6, 1), (1, 1)), ((5, 3), (6, 5)), ((6, 5), (5, 3)), ((1, 6), (1, 6))],
    ),
];
/// The ball's x in an observation of soccer, after the ant's own positions.
const BALL: usize = 15;
/// Side of a maze's cell, meters; D4RL's mazes have the same.
pub const CELL: f64 = 4.0;
/// Distance in the plane from the goal at which the ant is there, meters; D4RL's, too.
pub const ANT_REACH: f64 = 0.5;
/// And OGBench's ball.
const POINT_REACH: f64 = 1.0;

/// Whether a task's name, or a pattern of such names, is OGBench's.
pub fn is_ogbench(name: &str) -> bool {
    name.contains("-singletask")
}

/// What a task in a maze is: to come from somewhere to somewhere else.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MazeTask {
    /// Where the robot begins, but for noise: x and y, meters.
    pub start: [f64; 2],
    /// Where it must come: x and y, meters.
    pub goal: [f64; 2],
    /// Distance from there, in the plane, at which it counts as there, meters.
    pub reach: f64,
    /// Which of an observation's numbers is the x of what must come there; y is the next one.
    column: usize,
}

/// The task of an environment such as `humanoidmaze-large-singletask-task2-v0`; nothing for one
/// that is in none of OGBench's mazes.
pub fn maze_task(environment: &str) -> Option<MazeTask> {
    let (place, number) = parts(environment)?;
    let (_, tasks) = TASKS.iter().find(|(ending, _)| place.ends_with(ending))?;
    let is_soccer = place.starts_with("antsoccer");
    let default = if is_soccer { 4 } else { 1 };
    let (start, goal) = *tasks.get(number.unwrap_or(default).checked_sub(1)?)?;
    let center = |(row, column): Cell| [column, row].map(|cell| (f64::from(cell) - 1.0) * CELL);
    let reach = if place.starts_with("pointmaze") { POINT_REACH } else { ANT_REACH };
    Some(MazeTask {
        start: center(start),
        goal: center(goal),
        reach,
        column: if is_soccer { BALL } else { 0 },
    })
}

/// Robot and place of an environment's name, and the number of its task, if it says one.
fn parts(environment: &str) -> Option<(&str, Option<usize>)> {
    let (place, rest) = environment.strip_suffix("-v0")?.split_once("-singletask")?;
    let number = rest.strip_prefix("-task").map(str::parse).transpose().ok()?;
    (number.is_some() || rest.is_empty()).then_some((place, number))
}

/// The environment of the default task in the same place: the simulation that all five tasks there
/// share.
pub(crate) fn default_task(environment: &str) -> Option<String> {
    parts(environment).map(|(place, _)| format!("{place}-singletask-v0"))
}

/// What names of environments and tasks have after their place: the default task, then all.
pub(crate) fn endings() -> impl Iterator<Item = String> {
    let numbered = (1..=5).map(|number| format!("-singletask-task{number}-v0"));
    ["-singletask-v0".to_owned()].into_iter().chain(numbered)
}

/// Names that make a task.
pub struct TaskNames {
    /// Its own.
    pub task: String,
    /// The environment's.
    pub environment: String,
    /// The dataset's, where rewards follow from the observations alone.
    pub dataset: Option<String>,
    /// Whether it is the default task of its dataset.
    pub is_default: bool,
}

/// All tasks, those of a dataset one after the other.
pub fn tasks() -> impl Iterator<Item = TaskNames> {
    let of = |(place, kind, ending): (&str, &str, String)| {
        let environment = format!("{place}{ending}");
        let dataset = maze_task(&environment).map(|_| format!("{place}-{kind}-v0"));
        TaskNames {
            task: format!("{place}-{kind}{ending}"),
            environment,
            dataset,
            is_default: !ending.contains("-task"),
        }
    };
    kinds().flat_map(|(place, kind)| endings().map(move |ending| (place, kind, ending))).map(of)
}

fn kinds() -> impl Iterator<Item = (&'static str, &'static str)> {
    DATASETS.iter().flat_map(|(place, kinds)| kinds.iter().map(move |kind| (*place, *kind)))
}

/// The files of mazes. Their sizes and checksums are not known.
pub(crate) fn files() -> impl Iterator<Item = NamedDataset> {
    let mazes = kinds()
        .map(|(place, kind)| (format!("{place}-singletask-v0"), format!("{place}-{kind}-v0")));
    mazes.filter(|(environment, _)| maze_task(environment).is_some()).map(|(environment, name)| {
        let file = format!("{name}.npz");
        let addresses = vec![format!("https://rail.eecs.berkeley.edu/datasets/ogbench/{file}")];
        NamedDataset {
            name,
            environment,
            file,
            bytes: None,
            sha256: None,
            license: "MIT".to_owned(),
            addresses,
        }
    })
}

impl MazeTask {
    /// Gives a recording the rewards and masks of this task, in place of any others.
    pub(crate) fn label(self, recording: &mut Recording) {
        for row in 0..recording.rows() {
            let place = recording.observation(row).get(self.column..self.column + 2);
            let is_reached = place.is_some_and(|place| {
                let apart = [0, 1].map(|axis| f64::from(place[axis]) - self.goal[axis]);
                (apart[0] * apart[0] + apart[1] * apart[1]).sqrt() <= self.reach
            });
            recording.rewards[row] = f32::from(u8::from(is_reached));
            recording.terminals[row] = is_reached && recording.kinds[row] != RowKind::LastState;
            recording.timeouts[row] = recording.ends[row] && !is_reached;
        }
        recording.goal = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_say_where_a_task_is() {
        for (environment, expected) in [
            ("antmaze-large-singletask-v0", Some(([0.0, 0.0], [36.0, 24.0], 0.5, 0))),
            ("antmaze-giant-singletask-task4-v0", Some(([8.0, 28.0], [44.0, 16.0], 0.5, 0))),
            ("pointmaze-large-singletask-task4-v0", Some(([28.0, 8.0], [12.0, 16.0], 1.0, 0))),
            ("humanoidmaze-medium-singletask-task3-v0", Some(([8.0, 16.0], [4.0, 12.0], 0.5, 0))),
            ("antsoccer-arena-singletask-v0", Some(([20.0, 20.0], [0.0, 20.0], 0.5, 15))),
            ("antmaze-large-singletask-task6-v0", None),
            ("antmaze-large-singletask-task0-v0", None),
            ("antmaze-large-singletaskmaster-v0", None),
            ("antmaze-large-v0", None),
            ("cube-single-singletask-v0", None),
        ] {
            let found = maze_task(environment)
                .map(|MazeTask { start, goal, reach, column }| (start, goal, reach, column));
            assert_eq!(found, expected, "{environment}");
        }
    }

    #[test]
    fn tasks_and_files_are_those_that_are_published() {
        let (all, files) = (Vec::from_iter(tasks()), Vec::from_iter(files()));
        assert_eq!((all.len(), files.len()), (42 * 6, 24));
        let names = |at: usize| (&*all[at].task, &*all[at].environment, all[at].dataset.as_deref());
        let (task, environment) =
            ("antmaze-medium-navigate-singletask-task1-v0", "antmaze-medium-singletask-task1-v0");
        assert_eq!(names(36 + 1), (task, environment, Some("antmaze-medium-navigate-v0")));
        assert_eq!(
            names(42 * 6 - 1),
            ("puzzle-4x6-noisy-singletask-task5-v0", "puzzle-4x6-singletask-task5-v0", None)
        );
        assert!(all.iter().all(|task| task.task != "antmaze-giant-explore-singletask-v0"));
        let address =
            "https://rail.eecs.berkeley.edu/datasets/ogbench/antsoccer-medium-stitch-v0.npz";
        assert_eq!(files[23].addresses, [address]);
    }
}
