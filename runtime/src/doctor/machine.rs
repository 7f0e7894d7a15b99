//! Processor cores, and folders that a program writes to.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, absolute};
use std::time::{Duration, Instant};
use std::{env, thread};

use rustix::fs::statvfs;

use super::findings::Findings;

/// Limits the threads of the networks' arithmetic, which are rayon's.
const THREADS: &str = "RAYON_NUM_THREADS";
/// Size of the trial file, bytes: more than a file system keeps aside for small files.
const TRIAL: usize = 1 << 20;
/// A disk that takes longer than this for the trial delays scores: the learner synchronizes each
/// score before it counts.
const SLOW: Duration = Duration::from_millis(500);
/// Less free space than this is not enough for a checkpoint and some snapshots of the paper's
/// networks, bytes.
const TOO_LITTLE: u64 = 100 << 20;
/// A long run with many snapshots may need this much, bytes.
const LITTLE: u64 = 2 << 30;

/// The cores that this process may use, and how many threads it would start on them.
pub fn threads(findings: &mut Findings) {
    let cores = thread::available_parallelism().map_or(1, usize::from);
    let set = env::var(THREADS).ok();
    match set.as_ref().map(|text| text.parse::<usize>()) {
        None | Some(Ok(0)) => {
            findings.ok("threads", format!("{cores}, one per core: {THREADS} is not set or 0"))
        }
        Some(Ok(threads)) if threads <= cores => {
            findings.ok("threads", format!("{THREADS}={threads} of {cores} cores"))
        }
        Some(_) => findings.warn(
            "threads",
            format!(
                "{THREADS}={}, but this process may use {cores} cores",
                set.unwrap_or_default()
            ),
            format!("set it to a number from 1 to {cores}: more threads than cores are slow"),
        ),
    }
}

/// Checks a folder that a program will write to, or the nearest existing folder in which the
/// program would make it. `elsewhere` says how to choose another folder. Leaves no file behind.
pub fn folder(findings: &mut Findings, check: &str, path: &Path, elsewhere: &str) {
    let path = &absolute(path).unwrap_or_else(|_| path.to_owned());
    let folder = path.ancestors().find(|folder| folder.is_dir()).unwrap_or(path);
    let shown = path.display();
    let room = format!("make room: old runs' snapshots and checkpoints may go; {elsewhere}");
    let (free, took) = match write_trial(folder) {
        Ok(found) => found,
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
    let found = format!(
        "{shown}: {:.1} GiB free, a write of 1 MiB takes {took:.0?}",
        free as f64 / f64::from(1 << 30)
    );
    match free {
        ..TOO_LITTLE => findings.fail(check, found, room),
        TOO_LITTLE..LITTLE => {
            findings.warn(check, format!("{found}: little room for a long run"), room)
        }
        _ if took > SLOW => findings.warn(
            check,
            found,
            format!("a local disk, or one that is less busy, is faster; {elsewhere}"),
        ),
        _ => findings.ok(check, found),
    }
}

/// Writes a file, synchronizes it to the disk and removes it. Returns the free bytes, and how long
/// the trial took.
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
