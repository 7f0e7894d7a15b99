//! Checks of processor cores and of folders that a program writes to.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, absolute};
use std::time::{Duration, Instant};
use std::{env, thread};

use rustix::fs::statvfs;

use super::Findings;

/// Limits the threads of the networks' arithmetic, which are rayon's.
const THREADS: &str = "RAYON_NUM_THREADS";
/// Bytes of the trial file: more than a file system reserves for small files.
const TRIAL: usize = 1 << 20;
/// Longest time for the trial before a warning: the learner synchronizes each score before it counts.
const SLOW: Duration = Duration::from_millis(500);
/// Least free bytes for a checkpoint and some snapshots of the paper's networks.
const TOO_LITTLE: u64 = 100 << 20;
/// Free bytes that a long run with many snapshots may need.
const LITTLE: u64 = 2 << 30;

/// Checks the cores that this process may use, and its threads on them.
pub fn threads(findings: &mut Findings) {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let set = env::var(THREADS).unwrap_or_else(|_| "0".to_owned());
    match set.parse::<usize>() {
        Ok(0) => {
            findings.ok("threads", format!("{cores}, one per core: {THREADS} is not set or 0"));
        }
        Ok(threads) if threads <= cores => {
            findings.ok("threads", format!("{THREADS}={threads} of {cores} cores"));
        }
        _ => {
            let what = format!("{THREADS}={set}, but this process may use {cores} cores");
            let hint =
                format!("set it to a number from 1 to {cores}: more threads than cores are slow");
            findings.warn("threads", what, hint);
        }
    }
}

/// Checks a folder that a program will write to, or its nearest existing ancestor. `elsewhere` is the
/// hint for choosing another folder.
pub fn folder(findings: &mut Findings, check: &str, path: &Path, elsewhere: &str) {
    let path = &absolute(path).unwrap_or_else(|_| path.to_owned());
    let shown = path.display();
    let folder = path.ancestors().find(|folder| folder.exists()).unwrap_or(path);
    if !folder.is_dir() {
        let what = format!("{shown} cannot be made: {} is not a folder", folder.display());
        return findings.fail(check, what, elsewhere);
    }
    let room = format!("make room: old runs' snapshots and checkpoints may go; {elsewhere}");
    let (free, took) = match write_trial(folder) {
        Ok(trial) => trial,
        Err(error) => {
            let hint = match error.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => room,
                _ => format!(
                    "`ls -ld {}` says which users may write there; {elsewhere}",
                    folder.display()
                ),
            };
            return findings.fail(check, format!("{shown} cannot be written to: {error}"), hint);
        }
    };
    let gib = free as f64 / f64::from(1 << 30);
    let what = format!("{shown}: {gib:.1} GiB free, a write of 1 MiB takes {took:.0?}");
    match free {
        ..TOO_LITTLE => findings.fail(check, what, room),
        TOO_LITTLE..LITTLE => {
            findings.warn(check, format!("{what}: little room for a long run"), room);
        }
        _ if took > SLOW => {
            let faster = "a local disk, or one that is less busy, is faster";
            findings.warn(check, what, format!("{faster}; {elsewhere}"));
        }
        _ => findings.ok(check, what),
    }
}

/// Writes a file, synchronizes it and removes it. Returns the free bytes and the time of the trial.
fn write_trial(folder: &Path) -> io::Result<(u64, Duration)> {
    let path = folder.join(format!(".doctor-{}", std::process::id()));
    let begin = Instant::now();
    let mut file = File::create_new(&path)?;
    let written = file.write_all(&vec![0; TRIAL]).and_then(|()| file.sync_all());
    let took = begin.elapsed();
    fs::remove_file(&path)?;
    written?;
    let space = statvfs(folder)?;
    Ok((space.f_bavail.saturating_mul(space.f_frsize), took))
}
