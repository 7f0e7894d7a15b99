//! Results of a job, which the evaluator owes to the learner until they are acknowledged.

use quad_protocol::{
    CodecError, Episode, EpisodeScore, Hash, Job, Message, Name, Piece, ScoreReport, encode,
};

/// The results of a job.
#[derive(Debug)]
pub enum Owed {
    Scores(ScoreReport),
    Episode(Parcel),
}

/// An online episode on its way to the learner.
#[derive(Debug)]
pub struct Parcel {
    /// Steps of the episode.
    pub rows: u64,
    frame: Vec<u8>,
    /// The next piece, without its bytes.
    next: Piece,
}

impl Owed {
    /// The results of `played` episodes of `job`.
    ///
    /// # Errors
    /// An online episode cannot be delivered: a number is not finite, or it is too long.
    pub fn new(
        job: &Job,
        evaluator: Name,
        precision: Name,
        mut played: Vec<(EpisodeScore, Option<Episode>)>,
    ) -> Result<Owed, CodecError> {
        let Some(episode) = played.first_mut().and_then(|(_, episode)| episode.take()) else {
            let scores = played.into_iter().map(|(score, _)| score).collect();
            return Ok(Owed::Scores(ScoreReport::new(job, evaluator, precision, scores)));
        };
        episode.verify()?;
        let frame = encode(&episode)?;
        let next = Piece {
            evaluator,
            run: job.run.clone(),
            incarnation: job.incarnation,
            job: job.id,
            seed: episode.score.seed,
            hash: Hash::new(&frame),
            length: frame.len() as u32,
            offset: 0,
            bytes: Vec::new(),
        };
        Ok(Owed::Episode(Parcel { rows: episode.score.length.into(), frame, next }))
    }
}

impl Parcel {
    pub fn seed(&self) -> u64 {
        self.next.seed
    }

    /// The next piece.
    pub fn piece(&self) -> Piece {
        let rest = &self.frame[self.next.offset as usize..];
        Piece { bytes: rest[..rest.len().min(Piece::MOST)].to_vec(), ..self.next.clone() }
    }

    /// Goes on at the offset that the learner has named. Fails if that is not ahead: a learner that
    /// has lost what it had gets it after a pause.
    pub fn continue_at(&mut self, offset: u32) -> Result<(), String> {
        let Piece { seed, length, .. } = self.next;
        if offset >= length {
            return Err(format!("the episode with seed {seed} has {length} bytes, not {offset}"));
        }
        let before = std::mem::replace(&mut self.next.offset, offset);
        match offset > before {
            true => Ok(()),
            false => Err(format!("it wants the episode with seed {seed} from byte {offset} again")),
        }
    }
}
