//! The thread that writes scores to the disk. All that came while it was at the last ones go together, in one write and one
//! synchronisation. A slow disk delays the thanks for scores, and nothing else: jobs go out meanwhile.

use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread;
use std::time::Duration;

use quad_service::Beat;

use crate::hub::Event;
use crate::inbox::Inbox;
use crate::run_dir::{AuditLine, Log, PatientLog, ScoreLine};
use crate::trouble::Trouble;

/// After a write, scores are left to gather for so long: to synchronise a file takes much of a processor, too.
const GATHER: Duration = Duration::from_millis(50);

/// What is to be written.
#[derive(Debug)]
pub enum Lines {
    /// New scores; [`Event::Written`] is the answer.
    Scores(Vec<ScoreLine>),
    /// Episodes that were scored twice. Nobody waits for them.
    Audits(Vec<AuditLine>),
}

/// State of the thread.
#[derive(Debug)]
pub struct Scribe {
    /// `scores.jsonl`.
    pub scores: Log,
    /// Where episodes are written down that were scored twice, if any are to be.
    pub audits: Option<PatientLog<AuditLine>>,
    /// What is to be written, in its order.
    pub lines: Receiver<Lines>,
    /// Who is told.
    pub hub: Inbox<Event>,
    /// How the disk takes the scores.
    pub trouble: Trouble,
}

impl Scribe {
    /// The thread's work, until nobody can send lines any more.
    pub fn run(mut self, beat: &Beat) {
        loop {
            beat.alive();
            match self.lines.recv_timeout(beat.interval()) {
                Ok(Lines::Scores(lines)) => {
                    let written = self.scores.append(&lines);
                    let written = written.map_err(|error| format!("{:#}", anyhow::Error::from(error)));
                    match &written {
                        Ok(()) => self.trouble.over(beat),
                        Err(error) => self.trouble.refused(beat, error),
                    }
                    self.hub.send(Event::Written(written));
                    thread::sleep(GATHER);
                }
                Ok(Lines::Audits(lines)) => self.append_audits(lines),
                Err(RecvTimeoutError::Timeout) => self.append_audits(Vec::new()),
                Err(RecvTimeoutError::Disconnected) => return self.append_audits(Vec::new()),
            }
        }
    }

    fn append_audits(&mut self, lines: Vec<AuditLine>) {
        if let Some(log) = &mut self.audits {
            log.append(lines);
        }
    }
}
