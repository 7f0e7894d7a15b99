//! Readers and writers of the file formats, and the choice among the readers.

mod array;
pub(crate) mod arrays;
mod d4rl;
pub(crate) mod d4rl_writer;
mod foreign;
pub(crate) mod hdf5_file;
mod minari;
mod new_file;
mod npz_file;
mod ogbench;
pub(crate) mod recorded;

use std::path::{Path, PathBuf};

use self::hdf5_file::Hdf5File;
use self::npz_file::NpzFile;
use crate::error::{DatasetError, Problem};
use crate::normalize::Normalize;
use crate::recording::Recording;
use crate::tables::benchmarks::{self, Format};
use crate::tables::environment::{self, EnvironmentSpec};
use crate::tables::maze::MazeTask;
use crate::tables::reward::RewardRule;

pub use minari::minari_folder;

/// Options of [`Transitions::read`](crate::Transitions::read).
#[derive(Clone, Copy, Debug, Default)]
pub struct ReadOptions {
    /// Environment that provides dimensions, time limit and reference returns. Without it the
    /// dimensions are the source's, and a file without timeouts has none.
    pub environment: Option<&'static EnvironmentSpec>,
    /// Maze task that replaces the source's rewards and masks.
    pub task: Option<MazeTask>,
    /// Map from the source's rewards to those that are trained on.
    pub reward: RewardRule,
    /// Columns to normalize. Actions that are not normalized must be within [-1, 1].
    pub normalize: Normalize,
    /// Steps of a chunk that will be learned; 0 if that is not known.
    pub chunk: usize,
}

/// The file with the data: `main_data.hdf5` of a Minari folder, else the path itself.
pub fn data_file(path: impl AsRef<Path>) -> Result<PathBuf, DatasetError> {
    let path = path.as_ref();
    if !path.is_dir() {
        return Ok(path.to_owned());
    }
    minari::data_file(path).ok_or_else(|| DatasetError::new(path, foreign::from_folder(path)))
}

pub(crate) enum Source {
    D4rl(Hdf5File),
    Own(Hdf5File),
    Minari(Hdf5File, minari::Metadata),
    OgBench(NpzFile),
}

impl Source {
    pub(crate) fn open(path: &Path) -> Result<Self, DatasetError> {
        let error = |problem| DatasetError::new(path, problem);
        let file = data_file(path)?;
        if path.is_dir() {
            let metadata = minari::Metadata::read(&file)?;
            return Ok(Self::Minari(Hdf5File::open(&file)?, metadata));
        }
        let (_, start) = foreign::start_of(path).map_err(|source| error(source.into()))?;
        if Format::from_start(&start) == Some(Format::Npz) {
            return Ok(Self::OgBench(NpzFile::open(path)?));
        }
        let file = Hdf5File::open(path)?;
        match file.attribute("layout") {
            Some(layout) if layout == arrays::LAYOUT => return Ok(Self::Own(file)),
            Some(layout) => return Err(error(Problem::UnknownLayout(layout))),
            None => {}
        }
        let groups = file.members("data").unwrap_or_default();
        if let Some(name) = groups.iter().find(|name| name.starts_with("demo_")) {
            let has_rewards = file.has(&format!("data/{name}/rewards"));
            return Err(error(foreign::robomimic(has_rewards)));
        }
        if path.ends_with(minari::DATA_FILE) || file.has("episode_0") {
            return Ok(Self::Minari(file, minari::Metadata::read(path)?));
        }
        Ok(Self::D4rl(file))
    }

    pub(crate) fn format(&self) -> &'static str {
        match self {
            Self::D4rl(_) => "D4RL",
            Self::Own(_) => "transitions",
            Self::Minari(..) => "Minari",
            Self::OgBench(_) => "OGBench",
        }
    }

    pub(crate) fn environment(&self) -> Option<String> {
        match self {
            Self::D4rl(file) => file.text("metadata/environment"),
            Self::Minari(_, metadata) => metadata.environment(),
            Self::Own(_) | Self::OgBench(_) => None,
        }
    }

    /// Refuses a recording of an environment with other physics. OGBench files do not name theirs,
    /// but are never of a maze whose rewards are stored.
    pub(crate) fn check_environment(&self, asked: &EnvironmentSpec) -> Result<(), Problem> {
        let expected = asked.name.clone();
        let is_other_maze = asked.maze.is_some() && benchmarks::relabeling(&asked.name).is_none();
        if matches!(self, Self::OgBench(_)) && is_other_maze {
            return Err(Problem::OtherMaze(expected));
        }
        let Some(claimed) = self.environment() else { return Ok(()) };
        let simulation = environment::find(&claimed).map(EnvironmentSpec::simulation);
        if simulation == Ok(asked.simulation()) {
            return Ok(());
        }
        let is_simulated = simulation.is_ok();
        Err(Problem::OtherEnvironment(claimed, expected, is_simulated))
    }

    /// Reads all rows. `environment` gives the time limit and goal of a D4RL file; `task` replaces
    /// rewards and masks.
    pub(crate) fn read(
        &mut self,
        environment: Option<&EnvironmentSpec>,
        task: Option<MazeTask>,
    ) -> Result<Recording, DatasetError> {
        let (path, recording) = match self {
            Self::D4rl(file) => (file.path(), d4rl::read(file, environment)),
            Self::Own(file) => (file.path(), arrays::read_own(file)),
            Self::Minari(file, metadata) => (file.path(), minari::read(file, metadata)),
            Self::OgBench(file) => {
                let recording = ogbench::read(file, task);
                (file.path(), recording)
            }
        };
        let mut recording = recording.map_err(|problem| DatasetError::new(path, problem))?;
        if let Some(task) = task {
            task.label(&mut recording);
        }
        Ok(recording)
    }
}

/// Environment named in the source's metadata, as written by `evaluator collect` and Minari: a name
/// in the table of environments, or else Gymnasium's id.
pub fn recorded_environment(path: impl AsRef<Path>) -> Result<Option<String>, DatasetError> {
    Ok(Source::open(path.as_ref())?.environment())
}
