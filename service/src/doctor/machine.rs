//! Processor cores, threads, open files, the clock.

use std::time::{Duration, SystemTime, UNIX_EPOCH};
use std::{env, fs, io, thread};

use rustix::process::{Resource, getrlimit};
use x509_parser::time::ASN1Time;

use super::Findings;

/// Bounds the threads of the networks' arithmetic; rayon's.
const THREADS: &str = "RAYON_NUM_THREADS";
/// Fewer open files than this leave little room: each connection is one, and so is each file of a run.
const FEW_FILES: u64 = 1024;
/// The machine on which this program was made may be ahead by this much.
const CLOCK_TOLERANCE: Duration = Duration::from_secs(10);

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

/// The time that it is by this machine, which is wrong for certain if this program was made later. Nobody else is asked.
pub fn clock(findings: &mut Findings) {
    clock_at(findings, SystemTime::now(), fs::metadata("/proc/self/exe").and_then(|program| program.modified()));
}

fn clock_at(findings: &mut Findings, now: SystemTime, made: io::Result<SystemTime>) {
    let shown = |time: SystemTime| {
        let seconds = time.duration_since(UNIX_EPOCH).map_or(0, |time| time.as_secs() as i64);
        ASN1Time::from_timestamp(seconds)
            .map_or_else(|_| format!("second {seconds} since 1970"), |time| time.to_string())
    };
    let it_is = format!("it is {} by this machine", shown(now));
    match made {
        Ok(made) if made > now + CLOCK_TOLERANCE => findings.warn(
            "clock",
            format!("{it_is}, but this program is of {}", shown(made)),
            "set the clock, best by NTP (`timedatectl set-ntp true`): with a wrong one, certificates seem not to be valid",
        ),
        Ok(_) => findings.ok("clock", format!("{it_is}; this program is older, and nobody else was asked")),
        Err(_) => findings.ok("clock", format!("{it_is}; nobody else was asked")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_not_from_the_future() {
        let now = UNIX_EPOCH + Duration::from_secs(1_800_000_000);
        for (made, line) in [
            (Ok(now - Duration::from_secs(60)), "ok    clock  it is Jan 15 08:00:00 2027 +00:00 by this machine; this"),
            (Ok(now + Duration::from_secs(9)), "ok    clock"),
            (Ok(now + Duration::from_secs(60)), "warn  clock  it is Jan 15 08:00:00 2027 +00:00 by this machine, but"),
            (Err(io::ErrorKind::NotFound.into()), "ok    clock"),
        ] {
            let mut findings = Findings::default();
            clock_at(&mut findings, now, made);
            assert!(findings.to_string().starts_with(line), "{findings}");
        }
    }

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
