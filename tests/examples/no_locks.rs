//! A library to be preloaded: files have no locks, as on Lustre without `flock`. Stands in for
//! libc's `flock`.

use std::ffi::c_int;

/// Stands in for libc's.
#[unsafe(no_mangle)]
pub extern "C" fn flock(_file: c_int, _operation: c_int) -> c_int {
    // SAFETY: the system has a place for this thread's last error.
    unsafe { *libc::__errno_location() = libc::ENOSYS };
    -1
}
