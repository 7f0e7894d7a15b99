//! A library to be preloaded: a call never returns for files whose paths begin as [`HANGS`] says.
//! Stands in for libc's `fsync` and `read`.

use std::ffi::{c_int, c_long, c_void};
use std::fs;
use std::path::Path;
use std::thread::park;

use quad_tests::hanging_disk::HANGS;

/// Stands in for libc's.
#[unsafe(no_mangle)]
pub extern "C" fn fsync(file: c_int) -> c_int {
    hang("fsync", file);
    // SAFETY: it takes a descriptor, of whatever kind, and touches no memory of the program.
    unsafe { libc::syscall(libc::SYS_fsync, file) as c_int }
}

/// Stands in for libc's.
///
/// # Safety
/// As libc's: `buffer` has room for `count` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn read(file: c_int, buffer: *mut c_void, count: usize) -> isize {
    hang("read", file);
    // SAFETY: the caller's own arguments.
    unsafe { libc::syscall(libc::SYS_read as c_long, file, buffer, count) as isize }
}

/// Waits forever, if it is this call and one of these files.
fn hang(call: &str, file: c_int) {
    let hangs = std::env::var(HANGS).unwrap_or_default();
    let Some((hanging, beginning)) = hangs.split_once(':') else { return };
    let path = fs::read_link(Path::new("/proc/self/fd").join(file.to_string())).unwrap_or_default();
    while call == hanging && path.to_string_lossy().starts_with(beginning) {
        park();
    }
}
