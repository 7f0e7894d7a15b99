//! One message of each kind.

use std::fmt::Debug;

use quad_protocol::*;

/// A check of a message of any type.
pub trait Check {
    fn check<M: Message + PartialEq + Debug>(&mut self, message: &M);
}

/// Collects frames.
impl Check for Vec<Vec<u8>> {
    fn check<M: Message + PartialEq + Debug>(&mut self, message: &M) {
        self.push(encode(message).unwrap());
    }
}

/// The frames of all messages of [`each`].
pub fn frames() -> Vec<Vec<u8>> {
    let mut frames = Vec::new();
    each(&mut frames);
    frames
}

/// Decodes bytes as a message of each kind. A decoded message is encoded as the same bytes.
pub fn decode_as_each(bytes: &[u8]) {
    fn read<M: Message>(bytes: &[u8]) {
        if let Ok(message) = decode::<M>(bytes) {
            assert_eq!(encode(&message).unwrap(), bytes);
        }
    }
    read::<Snapshot>(bytes);
    read::<JobRequest>(bytes);
    read::<JobReply>(bytes);
    read::<ScoreReport>(bytes);
    read::<ScoreReply>(bytes);
    read::<Progress>(bytes);
    read::<Episode>(bytes);
    read::<Piece>(bytes);
    read::<PieceReply>(bytes);
}

fn name() -> Name {
    Name::new("some-name").unwrap()
}

/// A snapshot with this file.
pub fn snapshot(file: Vec<u8>) -> Snapshot {
    Snapshot { run: name(), incarnation: 1, step: 2, hash: Hash::new(&file), file }
}

/// Checks one message of each kind and variant, with all fields filled.
pub fn each(test: &mut impl Check) {
    let text = || "hopper".to_owned();
    let snapshot = snapshot((0..100).collect());
    let score = |seed, score| EpisodeScore { seed, episode_return: 2.0, length: 3, score };
    let job = Job {
        id: 1,
        run: name(),
        incarnation: 2,
        step: 3,
        weights: snapshot.hash,
        environment: text(),
        environment_seed: 4,
        seeds: vec![1, 2, 3],
        exploration: Some(Exploration::Policy { noise: 0.1 }),
        progress_milliseconds: 300,
    };
    let progress = Progress {
        episodes_done: 1,
        steps_done: 100,
        environment_steps: 200,
        episodes: 7,
        ..Progress::new(&job, name())
    };
    let episodes = vec![score(1, 4.0), score(u64::MAX, f64::NEG_INFINITY), score(3, -0.0)];
    let environments = vec![text(), "walker2d".to_owned(), String::new()];
    test.check(&snapshot);
    test.check(&JobRequest::Claim { evaluator: name(), attempt: 9, environments });
    test.check(&JobRequest::HandBack { evaluator: name(), job: 1, failed: Some(text()) });
    test.check(&ScoreReport::new(&job, name(), name(), episodes));
    test.check(&JobReply::Job(job.clone()));
    test.check(&JobReply::Wait { incarnation: 2, milliseconds: 10 });
    test.check(&JobReply::HandedBack { incarnation: 2, accepted: true });
    test.check(&ScoreReply::Recorded { incarnation: 1, new: 2, duplicates: 3 });
    test.check(&ScoreReply::NotYet { incarnation: 1 });
    test.check(&ScoreReply::Refused { incarnation: 1, reason: text() });
    test.check(&progress);
    test.check(&JobReply::Job(Job { exploration: Some(Exploration::Uniform), ..job }));
    test.check(&Episode {
        score: EpisodeScore { length: 1, ..score(1, 4.0) },
        terminated: true,
        observations: vec![0.0, 1.0],
        actions: vec![0.5],
        rewards: vec![2.0],
        interventions: vec![0],
        ..Episode::new(3, snapshot.hash, name(), 1)
    });
    test.check(&Piece {
        evaluator: name(),
        run: name(),
        incarnation: 2,
        job: 1,
        seed: 1,
        hash: snapshot.hash,
        length: 100,
        offset: 10,
        bytes: vec![1, 2, 3],
    });
    test.check(&PieceReply::Continue { incarnation: 1, offset: 2 });
    test.check(&PieceReply::Recorded { incarnation: 1, duplicate: true });
    test.check(&PieceReply::Refused { incarnation: 1, reason: text() });
}
