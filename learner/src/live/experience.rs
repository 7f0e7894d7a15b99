//! Deliveries of practice episodes: pieces are put together, checked, and written to the disk.
//!
//! A piece is small, since a learner takes no larger messages. There are as many episodes in
//! pieces as the run has open, and none is longer than the environment allows.

use std::collections::{BTreeMap, HashMap};

use anyhow::Context;
use quad_protocol::{CodecError, Episode, Hash, Piece, PieceReply, decode, practice_seed};
use quad_run::config::Experiment;
use quad_run::folder::{ExperienceLog, RunDir};
use quad_runtime::{Heartbeat, Hint};
use tracing::warn;

use super::coordinator::Coordinator;
use super::disk::DiskStatus;
use super::requests::{NotAccepted, Request};
use crate::evaluation::PracticeEpisode;
use crate::train::Inbox;

/// The hint of a checkpoint or log without the other.
pub(super) const OTHER_FOLDER: &str = "experience.log belongs to the run: copy it from where the checkpoint is from, or begin anew with --fresh";

/// Practice episodes on their way to the disk, and then to training.
pub(super) struct Experience {
    /// `experience.log`.
    log: ExperienceLog,
    inbox: Inbox,
    coordinator: Coordinator,
    /// The first bytes of frames, and the hashes of the whole, by seed.
    partial: BTreeMap<u64, (Hash, Vec<u8>)>,
}

/// The last piece's request, the number and the episode, which is complete.
type Whole = (Request, u64, Episode);

impl Experience {
    /// Opens the run's log, and puts what it has into the inbox. An episode that is not there may
    /// have been played, if the snapshot with which practice begins is there.
    pub fn open(
        dir: &RunDir,
        experiment: &Experiment,
        inbox: Inbox,
        coordinator: &Coordinator,
    ) -> anyhow::Result<Self> {
        let (log, records) = dir.experience_log()?;
        let by_seed = |(hash, episode): (Hash, Episode)| (episode.score.seed, (hash, episode));
        let mut episodes: HashMap<u64, _> = records.into_iter().map(by_seed).collect();
        let recorded = episodes.len() as u64;
        let lag = experiment.online.as_ref().map_or(0, |online| online.lag);
        let has_begun = dir.snapshots()?.contains(&experiment.steps);
        // Seeds are those of the first episodes: more were never open.
        for number in 0..recorded + u64::from(lag) {
            let seed = practice_seed(experiment.seed, number);
            if let Some((hash, episode)) = episodes.remove(&seed) {
                coordinator.record_practice(seed, hash);
                inbox.send((number, episode)).ok();
            } else if has_begun {
                coordinator.expect_practice(seed);
            }
        }
        let error = "experience.log has episodes of another run";
        episodes.is_empty().then_some(()).context(error).hint(OTHER_FOLDER)?;
        Ok(Self { log, inbox, coordinator: coordinator.clone(), partial: BTreeMap::new() })
    }

    /// Answers each piece. Episodes that are complete are written together first.
    pub fn receive(
        &mut self,
        pieces: Vec<(Request, Piece)>,
        disk: &mut DiskStatus,
        beat: &Heartbeat,
    ) {
        let mut whole = Vec::new();
        for (request, piece) in pieces {
            match self
                .add(&piece, |number| whole.iter().any(|(_, other, _): &Whole| *other == number))
            {
                Ok(Added::Reply(reply)) => request.reply(&reply),
                Ok(Added::Whole(number, episode)) => whole.push((request, number, episode)),
                Err(why @ NotAccepted::NotYet) => request.reject(&why, &self.coordinator.metrics),
                Err(why) => refuse(request, &why, &self.coordinator),
            }
        }
        if whole.is_empty() {
            return;
        }
        let partial = whole.iter().filter_map(|(_, _, it)| self.partial.get(&it.score.seed));
        match self.log.append(partial.map(|(_, frame)| frame.as_slice())) {
            Ok(()) => {
                disk.accepted(beat);
                for (request, number, episode) in whole {
                    let seed = episode.score.seed;
                    let Some((hash, _)) = self.partial.remove(&seed) else { continue };
                    // Training may have ended.
                    self.inbox.send((number, episode)).ok();
                    request.reply(&self.coordinator.record_practice(seed, hash));
                }
            }
            // The last piece completes them again when the evaluators deliver it again.
            Err(error) => {
                let error = format!("{:#}", anyhow::Error::from(error));
                disk.refused(beat, &error);
                for (request, ..) in whole {
                    let why = NotAccepted::NotSaved(error.clone());
                    request.reject(&why, &self.coordinator.metrics);
                }
            }
        }
    }

    /// Adds a piece; `is_whole` tells of the episodes that are to be written with it.
    fn add(&mut self, piece: &Piece, is_whole: impl Fn(u64) -> bool) -> Result<Added, NotAccepted> {
        let incarnation = self.coordinator.incarnation();
        let seed = piece.seed;
        let number = match self.coordinator.practice(piece)? {
            PracticeEpisode::Open { episode } => episode,
            PracticeEpisode::NotYet => return Err(NotAccepted::NotYet),
            PracticeEpisode::Recorded(hash) => {
                if hash != piece.hash {
                    self.coordinator.metrics.practice.differences.inc();
                    warn!(
                        seed, evaluator = %piece.evaluator,
                        "an episode was played again with other bits; the first delivery counts"
                    );
                }
                return Ok(Added::Reply(PieceReply::Recorded { incarnation, duplicate: true }));
            }
        };
        let at = |offset: usize| {
            let offset = offset as u32;
            Ok(Added::Reply(PieceReply::Continue { incarnation, offset }))
        };
        // Another evaluator's last piece came just before.
        if is_whole(number) {
            return at(piece.offset as usize);
        }
        let none = || (piece.hash, Vec::new());
        let (hash, bytes) = self.partial.entry(seed).or_insert_with(none);
        let offset = piece.offset as usize;
        if *hash != piece.hash {
            if offset > 0 {
                return at(0);
            }
            (*hash, *bytes) = none();
        }
        if offset == bytes.len() {
            bytes.extend_from_slice(&piece.bytes);
        }
        if bytes.len() < piece.length as usize {
            return at(bytes.len());
        }
        let found = Hash::of(bytes);
        if found != piece.hash {
            bytes.clear();
            return Err(CodecError::Hash { claimed: piece.hash, found }.into());
        }
        let episode: Episode = decode(bytes)?;
        self.coordinator.validate_practice(number, &episode)?;
        Ok(Added::Whole(number, episode))
    }
}

/// Tells an evaluator that its episode will never be accepted.
pub(super) fn refuse(request: Request, why: &NotAccepted, coordinator: &Coordinator) {
    coordinator.metrics.reject(why.label());
    let (incarnation, reason) = (coordinator.incarnation(), why.to_string());
    request.reply(&PieceReply::Refused { incarnation, reason });
}

enum Added {
    Reply(PieceReply),
    Whole(u64, Episode),
}

#[cfg(test)]
mod tests;
