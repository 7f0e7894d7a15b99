//! A library to be preloaded: has [`Disk`] keep what a program synchronizes. Stands in for libc's
//! `fsync` and `fdatasync`.
#![allow(clippy::expect_used)]

use std::ffi::{c_int, c_long};
use std::fs;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::thread::sleep;
use std::time::Duration;

use quad_tests::power::Disk;

/// A slow disk: so that a program is often killed between writing and synchronizing.
const DISK: Duration = Duration::from_millis(10);

/// Stands in for libc's.
#[unsafe(no_mangle)]
pub extern "C" fn fsync(file: c_int) -> c_int {
    synchronize(libc::SYS_fsync, file)
}

/// Stands in for libc's.
#[unsafe(no_mangle)]
pub extern "C" fn fdatasync(file: c_int) -> c_int {
    synchronize(libc::SYS_fdatasync, file)
}

fn synchronize(call: c_long, file: c_int) -> c_int {
    // One at a time: of two threads that synchronize one folder, the later one must be kept.
    static ONE: Mutex<()> = Mutex::new(());
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    sleep(DISK);
    // SAFETY: both calls take a descriptor, of whatever kind, and touch no memory of the program.
    let result = unsafe { libc::syscall(call, file) } as c_int;
    if result == 0 {
        let path = fs::read_link(Path::new("/proc/self/fd").join(file.to_string()))
            .expect("the file is open");
        Disk::of_environment().keep(&path).expect("the disk keeps it");
    }
    result
}
