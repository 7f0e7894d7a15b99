//! `learner train --dry-run`: what a run is and what it takes, as a file of the user's own that begins with comments.

use std::fs;
use std::path::Path;
use std::time::Duration;

use indicatif::{HumanBytes, HumanDuration};
use quad_dataset::Transitions;
use quad_service::print;

use crate::config::RunConfig;
use crate::train::Price;

/// From here on a time is told in hours.
const HOURS: f64 = 2.0 * 3600.0;

/// Measures and prints it.
///
/// # Errors
/// The run could not begin with these transitions.
pub fn foretell(path: &Path, config: &RunConfig, transitions: Transitions) -> anyhow::Result<()> {
    let experiment = &config.experiment;
    let price = Price::measure(experiment, config.run.device, transitions)?;
    let seconds = price.step * experiment.steps as f64;
    let time = match seconds {
        HOURS.. => format!("{:.1} hours", seconds / 3600.0),
        _ => HumanDuration(Duration::from_secs_f64(seconds)).to_string(),
    };
    let memory = peak_memory().map_or("an unknown amount".to_owned(), |bytes| HumanBytes(bytes).to_string());
    print(&format!(
        "# folder: {}\n# data: {}\n# time: {:.1} ms for a gradient step, measured over a second; {time} for {} of them\n\
         # memory: {memory}, without evaluators\n# disk: {} for snapshots and checkpoints\n\n{}",
        path.display(),
        config.dataset.summary(),
        price.step * 1000.0,
        experiment.steps,
        HumanBytes(price.bytes(experiment)),
        toml::to_string(experiment)?,
    ))
}

/// The most memory that this process has had, bytes.
fn peak_memory() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let kibibytes: u64 =
        status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?.split_whitespace().next()?.parse().ok()?;
    Some(kibibytes << 10)
}
