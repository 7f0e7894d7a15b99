//! A log whose lines nobody waits for.

use serde::Serialize;
use tracing::warn;

use super::{Log, RunDirError};

/// Most lines that wait for the disk; more push out the oldest.
const MOST_WAITING: usize = 10_000;

/// Keeps lines that the disk does not take, and writes them with later ones.
#[derive(Debug)]
pub struct PatientLog<T> {
    log: Log,
    waiting: Vec<T>,
    lost: usize,
    /// The disk has refused the last lines, and that was said.
    said: bool,
}

impl<T: Serialize> PatientLog<T> {
    /// Nothing waits yet.
    pub fn new(log: Log) -> Self {
        Self { log, waiting: Vec::new(), lost: 0, said: false }
    }

    /// Appends lines, after those that wait; without any, it only tries these again.
    pub fn append(&mut self, lines: impl IntoIterator<Item = T>) {
        self.waiting.extend(lines);
        if self.waiting.is_empty() {
            return;
        }
        match self.log.append(&self.waiting) {
            Ok(()) => {
                self.waiting.clear();
                self.said = false;
            }
            Err(error) => {
                self.say(error);
                let excess = self.waiting.len().saturating_sub(MOST_WAITING);
                self.waiting.drain(..excess);
                self.lost += excess;
            }
        }
    }

    fn say(&mut self, error: RunDirError) {
        if !self.said {
            self.said = true;
            warn!("{:#}; what belongs there is kept for later", anyhow::Error::from(error));
        }
    }
}

impl<T> Drop for PatientLog<T> {
    fn drop(&mut self) {
        let lost = self.lost + self.waiting.len();
        if lost > 0 {
            warn!("{lost} lines are missing in {}", self.log.path().display());
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn what_the_disk_does_not_take_comes_later_in_its_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.jsonl");
        // To that device nothing can be written.
        let mut log = PatientLog::new(Log::unchecked("/dev/full".into()));
        log.append([1, 2]);
        log.append([3]);
        log.append([]);
        assert_eq!(log.waiting, [1, 2, 3]);
        log.log = Log::unchecked(path.clone());
        log.append([4]);
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "1\n2\n3\n4\n");
        assert!(log.waiting.is_empty() && log.lost == 0);
        log.log = Log::unchecked("/dev/full".into());
        log.append(0..MOST_WAITING + 7);
        assert_eq!((log.waiting[0], log.waiting.len(), log.lost), (7, MOST_WAITING, 7));
    }
}
