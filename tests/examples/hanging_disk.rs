//! A library to be preloaded: `fsync` never returns for files whose paths begin as [`HANGS`] says.
//! Stands in for libc's.

use std::ffi::c_int;
use std::fs;
use std::path::Path;
use std::thread::park;

use quad_tests::disk::HANGS;

/// Stands in for libc's.
#[unsafe(no_mangle)]
pub extern "C" fn fsync(file: c_int) -> c_int {
    let path = fs::read_link(Path::new("/proc/self/fd").join(file.to_string())).unwrap_or_default();
    let hangs = std::env::var(HANGS).is_ok_and(|start| path.to_string_lossy().starts_with(&start));
    if hangs {
        loop {
            park();
        }
    }
    // SAFETY: it takes a descriptor, of whatever kind, and touches no memory of the program.
    unsafe { libc::syscall(libc::SYS_fsync, file) as c_int }
}
