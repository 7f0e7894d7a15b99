//! Finds the snapshots to judge, by the paths of runs or of files.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use quad_policy::{Chunk, Header, Policy, PolicyError, Precision, load_policy};
use quad_protocol::{Hash, Origin};
use quad_run::config::RunConfig;
use quad_run::counted;
use quad_run::folder::{RunDir, walk};
use quad_runtime::Hint;

const HELP: &str = "what can be judged is the folder of a run, or a snapshot in it, like RUN/snapshots/step_000020000.safetensors";

pub(super) struct Snapshot {
    pub folder: RunDir,
    pub config: RunConfig,
    pub step: u64,
    /// BLAKE3 of the file.
    pub weights: String,
    pub policy: Box<dyn Policy>,
    /// Why it acts otherwise in an episode than it is judged.
    pub caveat: Option<String>,
}

/// The last snapshot of each run in or below a folder, and each snapshot that is named itself;
/// duplicates once.
pub(super) fn find(paths: &[PathBuf]) -> anyhow::Result<Vec<Snapshot>> {
    let mut snapshots = Vec::new();
    for path in paths {
        if path.is_file() {
            snapshots.push(from_file(path)?);
            continue;
        }
        let runs = walk(path, &mut |_, _| ());
        if runs.is_empty() {
            // Fails with the reason.
            RunDir::at(path).read_config().hint(HELP)?;
        }
        for run in runs {
            let folder = RunDir::at(&run);
            let Some(step) = folder.snapshots()?.pop() else {
                return Err(anyhow!("the run in {} has no snapshot yet", run.display()))
                    .hint("train it further, or leave it out");
            };
            snapshots.push(Snapshot::read(folder, step)?);
        }
    }
    let mut seen = BTreeSet::new();
    snapshots.retain(|snapshot| seen.insert(snapshot.weights.clone()));
    Ok(snapshots)
}

fn from_file(path: &Path) -> anyhow::Result<Snapshot> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let number = name.trim_start_matches("step_").trim_end_matches(".safetensors");
    let run = path.parent().and_then(Path::parent).map(RunDir::at);
    if let (Ok(step), Some(run)) = (number.parse(), run)
        && run.snapshot_path(step) == path
    {
        return Snapshot::read(run, step);
    }
    let text = "is in no run's folder, so that nothing says what it has learned from";
    Err(anyhow!("{} {text}", path.display())).hint(HELP)
}

/// An episode's first observation stands for those before it, and a chunk begins there.
fn caveat(&Chunk { history, replan, .. }: &Chunk) -> Option<String> {
    let mut acts = Vec::new();
    if history > 1 {
        acts.push(format!("sees {}", counted(history, "observation")));
    }
    if replan > 1 {
        acts.push(format!("executes {}", counted(replan, "action")) + " of a chunk");
    }
    let acts = acts.join(" and ");
    let caveat = format!("judged as if each state were an episode's first, but it {acts}");
    (!acts.is_empty()).then_some(caveat)
}

impl Snapshot {
    fn read(folder: RunDir, step: u64) -> anyhow::Result<Self> {
        let config = folder.read_config()?;
        let file = folder.read_snapshot(step)?;
        let path = folder.snapshot_path(step);
        let load = || {
            let header = Header::<Origin>::read(&file)?;
            Ok((load_policy(&file, Precision::F32)?, header.chunk))
        };
        let (policy, chunk) = load()
            .map_err(|error: PolicyError| anyhow!("{} is not a policy: {error}", path.display()))
            .hint(HELP)?;
        Ok(Self {
            caveat: caveat(&chunk),
            step,
            weights: Hash::new(&file).to_string(),
            policy,
            config,
            folder,
        })
    }
}
