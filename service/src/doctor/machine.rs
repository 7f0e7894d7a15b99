//! Processor cores, threads, open files.

use std::env;
use std::thread;

use rustix::process::{Resource, getrlimit};

use super::Findings;

/// Bounds the threads of the networks' arithmetic; rayon's.
const THREADS: &str = "RAYON_NUM_THREADS";
/// Fewer open files than this leave little room: each connection is one, and so is each file of a run.
const FEW_FILES: u64 = 1024;

/// The cores that this process may use, and how many threads it would start on them.
pub fn threads(findings: &mut Findings) {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    threads_for(findings, cores, env::var(THREADS).ok().as_deref());
}

fn threads_for(findings: &mut Findings, cores: usize, setting: Option<&str>) {
    let may = format!("this process may use {cores} {}", if cores == 1 { "core" } else { "cores" });
    let hint = format!("set {THREADS} to a number from 1 to {cores}, or leave it out for all of them");
    match setting.map(|text| (text, text.trim().parse::<usize>())) {
        None | Some((_, Ok(0))) => findings.ok("threads", format!("{may}, and will use all: {THREADS} is not set")),
        Some((text, Err(_))) => {
            findings.warn("threads", format!("{THREADS}={text} is no number; it is ignored, and {may}"), hint);
        }
        Some((_, Ok(threads))) if threads > cores => findings.warn(
            "threads",
            format!("{may}, but {THREADS} is {threads}: threads that wait for each other's cores are slow"),
            hint,
        ),
        Some((_, Ok(threads))) => findings.ok("threads", format!("{threads}, by {THREADS}; {may}")),
    }
}

/// How many files and connections this process may have open.
pub fn open_files(findings: &mut Findings) {
    match getrlimit(Resource::Nofile).current {
        Some(limit) if limit < FEW_FILES => findings.warn(
            "open files",
            format!("at most {limit}; each connection and each file of a run takes one"),
            format!("`ulimit -n {FEW_FILES}` before the start, LimitNOFILE= in a systemd unit, or nofile in Compose"),
        ),
        Some(limit) => findings.ok("open files", format!("at most {limit}")),
        None => findings.ok("open files", "no limit"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_make_no_sense_here_are_told() {
        for (setting, line) in [
            (None, "ok    threads  this process may use 4 cores, and will use all"),
            (Some("0"), "ok    threads  this process may use 4 cores, and will use all"),
            (Some("4"), "ok    threads  4, by RAYON_NUM_THREADS"),
            (Some("5"), "warn  threads  this process may use 4 cores, but RAYON_NUM_THREADS is 5"),
            (Some("many"), "warn  threads  RAYON_NUM_THREADS=many is no number"),
        ] {
            let mut findings = Findings::default();
            threads_for(&mut findings, 4, setting);
            assert!(findings.to_string().starts_with(line), "{setting:?}: {findings}");
        }
    }
}
