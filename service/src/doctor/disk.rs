//! Whether a folder can be written to, and how much of it.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, absolute};
use std::time::{Duration, SystemTime};

use rustix::fs::statvfs;

use super::Findings;

/// What is written as a trial, bytes: more than a file system keeps aside for small files.
const TRIAL: usize = 1 << 20;
/// Less free space than this is not enough for a checkpoint and some snapshots of the paper's networks, bytes.
const TOO_LITTLE: u64 = 100 << 20;
/// A long run with many snapshots may need this much, bytes.
const LITTLE: u64 = 2 << 30;
/// Free inodes: a run has some hundred files.
const FEW_INODES: u64 = 1000;
/// A file's time may be off by this much before that is worth a word.
const CLOCK_TOLERANCE: Duration = Duration::from_secs(10);

/// Checks a folder that a program will write to, or the one that it would be made in. `elsewhere` says how to choose
/// another one. Nothing is left behind.
pub fn folder(findings: &mut Findings, check: &str, path: &Path, elsewhere: &str) {
    let path = &absolute(path).unwrap_or_else(|_| path.to_owned());
    let folder = path.ancestors().find(|folder| folder.is_dir()).unwrap_or(path);
    let shown = match folder == path {
        true => path.display().to_string(),
        false => format!("{} (to be made in {})", path.display(), folder.display()),
    };
    let written = match write_trial(folder) {
        Ok(written) => written,
        Err(error) => {
            let hint = match error.kind() {
                io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
                    format!("make room: old runs' snapshots and checkpoints may go; {elsewhere}")
                }
                _ => format!("`ls -ld {}` says who may write there; {elsewhere}", folder.display()),
            };
            return findings.fail(check, format!("{shown} cannot be written to: {error}"), hint);
        }
    };
    space(findings, check, folder, &shown, elsewhere);
    times(findings, folder, written, SystemTime::now());
}

/// Writes a file, to the disk itself, and removes it; gives the time that the file system gave it.
fn write_trial(folder: &Path) -> io::Result<SystemTime> {
    let path = folder.join(format!(".doctor-{}", std::process::id()));
    let mut file = OpenOptions::new().write(true).create_new(true).open(&path)?;
    let written =
        file.write_all(&vec![0; TRIAL]).and_then(|()| file.sync_all()).and_then(|()| file.metadata()?.modified());
    let removed = fs::remove_file(&path);
    written.and_then(|time| removed.map(|()| time))
}

fn space(findings: &mut Findings, check: &str, folder: &Path, shown: &str, elsewhere: &str) {
    let found = match statvfs(folder) {
        Ok(found) => found,
        Err(error) => {
            return findings.warn(check, format!("{shown}: no word about its space: {error}"), "look with `df`");
        }
    };
    let free = found.f_bavail.saturating_mul(found.f_frsize);
    let room = format!("{shown} has {:.1} GiB free", free as f64 / f64::from(1 << 30));
    let make_room = format!("make room: old runs' snapshots and checkpoints may go; {elsewhere}");
    // Some file systems have no fixed number of inodes, and say 0 of 0.
    let few_inodes = found.f_files > 0 && found.f_favail < FEW_INODES;
    match free {
        ..TOO_LITTLE => findings.fail(check, room, make_room),
        _ if few_inodes => findings.fail(
            check,
            format!("{room}, but room for {} more files only", found.f_favail),
            format!("`df -i` shows it; remove folders of many small files; {elsewhere}"),
        ),
        TOO_LITTLE..LITTLE => findings.warn(check, format!("{room}: little for a long run"), make_room),
        _ => findings.ok(check, room),
    }
}

/// The trial's time by the file system, which for a folder of another machine is that machine's, and those of the files that
/// lie there already, against this machine's clock.
fn times(findings: &mut Findings, folder: &Path, written: SystemTime, now: SystemTime) {
    let ahead = |time: SystemTime| time.duration_since(now).unwrap_or_default();
    let off = ahead(written).max(now.duration_since(written).unwrap_or_default());
    let entries = fs::read_dir(folder).into_iter().flatten().filter_map(Result::ok);
    let newest = entries.filter_map(|entry| entry.metadata().ok()?.modified().ok()).max().unwrap_or(written);
    let hint = "set the clock, best by NTP (`timedatectl set-ntp true`)";
    if off > CLOCK_TOLERANCE {
        let what = format!("{} and this machine differ by {off:.0?}", folder.display());
        findings.warn("file times", what, hint);
    } else if ahead(newest) > CLOCK_TOLERANCE {
        let what = format!("{} has a file from {:.0?} in the future", folder.display(), ahead(newest));
        findings.warn("file times", what, hint);
    } else {
        findings.ok("file times", format!("{} has no file from the future", folder.display()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_there_and_one_that_is_not_yet() {
        let folder = tempfile::tempdir().unwrap();
        for path in [folder.path().to_owned(), folder.path().join("runs/a")] {
            let mut findings = Findings::default();
            super::folder(&mut findings, "run folder", &path, "choose another");
            assert!(findings.verdict().is_ok(), "{findings}");
            assert!(findings.to_string().contains("GiB free"), "{findings}");
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left behind");
    }

    #[test]
    fn a_folder_that_nobody_may_write_to() {
        let mut findings = Findings::default();
        folder(&mut findings, "run folder", Path::new("/proc/runs/a"), "choose another");
        let text = findings.to_string();
        assert!(
            findings.verdict().is_err() && text.contains("cannot be written to") && text.contains("hint:"),
            "{text}"
        );
    }

    #[test]
    fn clocks_that_differ_and_files_from_the_future() {
        let folder = tempfile::tempdir().unwrap();
        let now = SystemTime::now();
        let told = |written| {
            let mut findings = Findings::default();
            times(&mut findings, folder.path(), written, now);
            findings.to_string()
        };
        assert!(told(now).starts_with("ok "), "{}", told(now));
        for off in [now - Duration::from_secs(60), now + Duration::from_secs(60)] {
            assert!(told(off).contains("differ by 60s"), "{}", told(off));
        }
        let file = fs::File::create(folder.path().join("scores.jsonl")).unwrap();
        file.set_modified(now + Duration::from_secs(3600)).unwrap();
        assert!(told(now).contains("from 3600s in the future"), "{}", told(now));
    }
}
