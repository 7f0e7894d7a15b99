//! Names of tasks, by which runs are compared.

use std::collections::{BTreeMap, BTreeSet};

use quad_run::results::RunReport;

/// Adds environment and data to the names of tasks that have several of them in these runs, such as
/// `own-data` of two robots.
pub fn tell_apart(runs: &mut [RunReport]) {
    let mut settings: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for run in &*runs {
        settings.entry(run.task.clone()).or_default().insert(setting(run));
    }
    for run in runs.iter_mut().filter(|run| settings[&run.task].len() > 1) {
        run.task = format!("{} ({})", run.task, setting(run));
    }
}

/// The environment and the beginning of the data's SHA-256, which older runs lack.
fn setting(run: &RunReport) -> String {
    let sha256 = run.config.dataset.sha256.as_deref().unwrap_or("unknown");
    format!("{}, data {sha256:.8}", run.config.experiment.environment)
}
