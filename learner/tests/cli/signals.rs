//! Signals to a learner that reads its first file.

use std::fs::OpenOptions;
use std::os::unix::fs::OpenOptionsExt;
use std::process::{Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

/// `O_NONBLOCK`: a pipe without a reader cannot be opened, instead of being waited for.
const NOW: i32 = 0o4000;

#[test]
fn a_signal_before_training_begins_leaves_the_run_to_the_same_command() {
    for command in ["train --preset", "sweep"] {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("pipe.toml");
        assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let mut learner = Command::new(env!("CARGO_BIN_EXE_learner"));
        learner.args(command.split(' ')).arg(&pipe).stderr(Stdio::null());
        let mut learner = learner.spawn().unwrap();
        // Held open, so that the learner goes on reading.
        let _pipe = loop {
            match OpenOptions::new().write(true).custom_flags(NOW).open(&pipe) {
                Ok(pipe) => break pipe,
                Err(_) => assert_eq!(learner.try_wait().unwrap(), None, "{command}"),
            }
            sleep(Duration::from_millis(10));
        };
        let pid = learner.id().to_string();
        assert!(Command::new("kill").args(["-TERM", &pid]).status().unwrap().success());
        assert_eq!(learner.wait().unwrap().code(), Some(75), "{command}");
    }
}
