//! The policies to be judged, found by the paths of their runs or of their files.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow};
use quad_policy::{Policy, PolicyError, Precision, load_policy};
use quad_protocol::Hash;
use quad_run::config::RunConfig;
use quad_run::run::{RunDir, walk};
use quad_runtime::Hint;

const ONE: &str = "what can be judged is the folder of a run, or a snapshot in it, like RUN/snapshots/step_000020000.safetensors";

/// A policy to be judged.
pub(super) struct Subject {
    pub folder: RunDir,
    pub config: RunConfig,
    /// Name of the run.
    pub run: String,
    /// Gradient step.
    pub step: u64,
    /// BLAKE3 of the file.
    pub weights: String,
    pub policy: Box<dyn Policy>,
    /// Numbers of the episodes that its run has not learned from.
    pub held_out: BTreeSet<usize>,
}

/// The last snapshot of each run in or below a folder, and each snapshot that is named itself; a
/// policy that is named twice, once.
///
/// # Errors
/// There is no such policy, or it cannot be read.
pub(super) fn find(paths: &[PathBuf]) -> anyhow::Result<Vec<Subject>> {
    let mut subjects = Vec::new();
    for path in paths {
        if path.is_file() {
            subjects.push(of_file(path)?);
            continue;
        }
        let mut unreadable = None;
        let runs = walk(path, &mut |path, error| unreadable = Some((path.to_owned(), error)));
        if let Some((path, error)) = unreadable.filter(|_| runs.is_empty()) {
            return Err(error).with_context(|| format!("cannot read {}", path.display())).hint(ONE);
        }
        if runs.is_empty() {
            return Err(anyhow!("there is no run in {}", path.display())).hint(ONE);
        }
        for run in runs {
            let folder = RunDir::at(&run);
            let Some(step) = folder.snapshots()?.pop() else {
                return Err(anyhow!("the run in {} has no snapshot yet", run.display()))
                    .hint("train it further, or leave it out");
            };
            subjects.push(Subject::read(folder, step)?);
        }
    }
    let mut seen = BTreeSet::new();
    subjects.retain(|subject| seen.insert(subject.weights.clone()));
    Ok(subjects)
}

fn of_file(path: &Path) -> anyhow::Result<Subject> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let step =
        name.strip_prefix("step_").and_then(|name| name.strip_suffix(".safetensors")?.parse().ok());
    let run = path.parent().and_then(Path::parent).filter(|folder| RunDir::is_occupied(folder));
    let (Some(step), Some(run)) = (step, run) else {
        return Err(anyhow!(
            "{} is in no run's folder, so that nothing says what it has learned from",
            path.display()
        ))
        .hint(ONE);
    };
    Subject::read(RunDir::at(run), step)
}

impl Subject {
    fn read(folder: RunDir, step: u64) -> anyhow::Result<Self> {
        let (config, path) = (folder.read_config()?, folder.snapshot_path(step));
        let file = folder.read_snapshot(step)?;
        let refused = |error: PolicyError| anyhow!("{} is not a policy: {error}", path.display());
        let policy = load_policy(&file, Precision::F32).map_err(refused).hint(ONE)?;
        Ok(Self {
            run: config.run.name.to_string(),
            step,
            weights: Hash::of(&file).to_string(),
            policy,
            held_out: config.dataset.held_out.iter().copied().collect(),
            config,
            folder,
        })
    }
}
