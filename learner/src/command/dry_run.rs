//! `learner train --dry-run`: prints a run's values as a preset file, and its cost as comments at
//! the top.

use std::fs;
use std::path::Path;
use std::time::Duration;

use indicatif::{HumanBytes, HumanDuration};
use quad_dataset::Split;
use quad_run::config::RunConfig;
use quad_runtime::print;

use crate::train::RunCost;

pub fn estimate(path: &Path, config: &RunConfig, data: Split) -> anyhow::Result<()> {
    let experiment = &config.experiment;
    let steps = experiment.total_steps() - experiment.schedule().start;
    let cost = RunCost::measure(experiment, config.run.device, data)?;
    let milliseconds = cost.step_seconds * 1e3;
    let total = Duration::try_from_secs_f64((cost.step_seconds * steps as f64).ceil());
    let total = HumanDuration(total.unwrap_or(Duration::MAX));
    let (mut grows, mut kept) = (String::new(), "snapshots and checkpoints");
    if let Some(online) = &experiment.online {
        let bytes = HumanBytes(cost.experience_bytes(online.steps));
        (grows, kept) =
            (format!("; experience adds {bytes}"), "snapshots, checkpoints and experience");
    }
    print(&format!(
        "# folder: {}\n# data: {}\n# time: {milliseconds:.1} ms a gradient step, measured over a second; {total} for all \
         {steps}\n# memory: {}, without evaluators{grows}\n# disk: {} for {kept}\n\n{}",
        path.display(),
        config.dataset.summary(),
        peak_memory().map_or("unknown".to_owned(), |bytes| HumanBytes(bytes).to_string()),
        HumanBytes(cost.bytes(experiment)),
        toml::to_string(experiment)?,
    ))
}

/// Peak memory of this process in bytes.
fn peak_memory() -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(peak.trim().strip_suffix(" kB")?.parse::<u64>().ok()? << 10)
}
