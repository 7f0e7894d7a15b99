//! A disk that hangs when a program synchronizes or reads certain files.

use std::path::Path;

use crate::process::preload;

/// Variable with the call and the beginning of the files' paths, for examples/hanging_disk.rs.
pub const HANGS: &str = "QUAD_TEST_HANGS";

/// Command line prefix of a program in which `call`, `fsync` or `read`, never returns for paths that
/// begin with `file`.
pub fn launcher(call: &str, file: &Path) -> Vec<String> {
    let mut words = preload("hanging_disk");
    words.push(format!("{HANGS}={call}:{}", file.display()));
    words
}
