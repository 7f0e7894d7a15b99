//! A disk that hangs when a program synchronizes or reads certain files.

use std::path::Path;

use crate::process::preload;

/// The variable that tells the preloaded library, examples/hanging_disk.rs, of the call and the
/// beginning of the files' paths.
pub const HANGS: &str = "QUAD_TEST_HANGS";

/// The words that start a program in which this call, `fsync` or `read`, never returns for a file,
/// and for what is written to become it.
pub fn launcher(call: &str, file: &Path) -> Vec<String> {
    let mut words = preload("hanging_disk");
    words.push(format!("{HANGS}={call}:{}", file.display()));
    words
}
