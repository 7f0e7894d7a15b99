//! Messages with some bytes changed: every decoder gives a message or an error, and never panics. What comes out is the same
//! message when it is sent on.
//!
//! `QUAD_MUTATIONS=1000000 cargo test --release -p quad-protocol --test mutations` tries as many.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::Index;
use quad_protocol::*;

/// So many without the variable: a second or two.
const MUTATIONS: u32 = 200_000;

fn mutations() -> u32 {
    std::env::var("QUAD_MUTATIONS").ok().map_or(MUTATIONS, |text| text.parse().expect("QUAD_MUTATIONS is a number"))
}

fn name() -> Name {
    Name::new("some-name").unwrap()
}

/// One of each kind and variant, with all of its fields filled.
fn frames() -> Vec<Vec<u8>> {
    let text = || "hopper".to_owned();
    let tensors: Vec<u8> = (0..100).collect();
    let weights = Hash::of(&tensors);
    let schema = Schema { environment: text(), observation_dim: 11, action_dim: 3, policy: "diffusion".to_owned() };
    let episodes = vec![EpisodeScore { seed: 1, episode_return: 2.0, length: 3, score: 4.0 }; 3];
    let lease = Lease::random();
    let job = Job {
        id: 1,
        lease: lease.clone(),
        run: name(),
        incarnation: 2,
        step: 3,
        weights,
        environment: text(),
        instance: 4,
        seeds: vec![1, 2, 3],
        candidates: 10,
        lease_milliseconds: 1000,
    };
    let progress = Progress {
        evaluator: name(),
        run: name(),
        incarnation: 2,
        job: 1,
        step: 3,
        episodes_done: 1,
        episodes_total: 3,
        steps_done: 100,
        environment_steps: 200,
        episodes: 7,
        proof: weights,
    };
    let environments = vec![text(), "walker2d".to_owned()];
    let cannot_act = Some(CannotAct::signed("NaN".to_owned(), weights, &lease));
    vec![
        encode(&Snapshot { run: name(), incarnation: 1, step: 2, schema, hash: weights, tensors }).unwrap(),
        encode(&JobRequest::Claim { evaluator: name(), attempt: 9, environments, precision: name() }).unwrap(),
        encode(&JobRequest::HandBack { evaluator: name(), job: 1, lease: lease.clone() }).unwrap(),
        encode(&JobReply::Job(job)).unwrap(),
        encode(&JobReply::Wait { incarnation: 2, milliseconds: 10 }).unwrap(),
        encode(&JobReply::HandedBack { incarnation: 2, accepted: true }).unwrap(),
        encode(&ScoreReport {
            evaluator: name(),
            run: name(),
            incarnation: 1,
            job: 2,
            step: 3,
            weights,
            precision: name(),
            episodes: episodes.clone(),
            cannot_act,
        })
        .unwrap(),
        encode(&ScoreReply::Recorded { incarnation: 1, new: 2, duplicates: 3 }).unwrap(),
        encode(&ScoreReply::Refused { incarnation: 1, reason: text() }).unwrap(),
        encode(&WeightsRequest { evaluator: name() }).unwrap(),
        encode(&RecordedScores { run: name(), step: 1, weights, evaluator: name(), episodes }).unwrap(),
        encode(&progress.signed(&lease)).unwrap(),
    ]
}

/// Something that happens to bytes.
#[derive(Clone, Debug)]
enum Mutation {
    Flip(Index, u8),
    Write(Index, u64),
    Insert(Index, Vec<u8>),
    Remove(Index, usize),
    Repeat(Index, usize),
}

fn mutation() -> impl Strategy<Value = Mutation> {
    let interesting = prop_oneof![any::<u64>(), Just(u64::MAX), Just(0), 0_u64..300, Just(1 << 32), Just(1 << 20)];
    prop_oneof![
        (any::<Index>(), 0_u8..8).prop_map(|(at, bit)| Mutation::Flip(at, bit)),
        (any::<Index>(), interesting).prop_map(|(at, value)| Mutation::Write(at, value)),
        (any::<Index>(), vec(any::<u8>(), 1..20)).prop_map(|(at, bytes)| Mutation::Insert(at, bytes)),
        (any::<Index>(), 1_usize..20).prop_map(|(at, count)| Mutation::Remove(at, count)),
        (any::<Index>(), 1_usize..40).prop_map(|(at, count)| Mutation::Repeat(at, count)),
    ]
}

impl Mutation {
    fn apply(&self, frame: &mut Vec<u8>) {
        if frame.is_empty() {
            return;
        }
        let (Self::Flip(at, _) | Self::Write(at, _) | Self::Insert(at, _) | Self::Remove(at, _) | Self::Repeat(at, _)) =
            self;
        let at = at.index(frame.len());
        let until = |count: usize| (at + count).min(frame.len());
        match self {
            Self::Flip(_, bit) => frame[at] ^= 1 << bit,
            Self::Write(_, value) => {
                let end = until(8);
                frame[at..end].copy_from_slice(&value.to_le_bytes()[..end - at]);
            }
            Self::Insert(_, bytes) => drop(frame.splice(at..at, bytes.iter().copied())),
            Self::Remove(_, count) => drop(frame.drain(at..until(*count))),
            Self::Repeat(_, count) => {
                let part = frame[at..until(*count)].to_vec();
                drop(frame.splice(at..at, part));
            }
        }
    }
}

fn decode_as<M: Message>(frame: &[u8]) {
    if let Ok(message) = decode::<M>(frame) {
        assert_eq!(encode(&message).unwrap(), frame, "what was read is what is sent on");
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: mutations(), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_decoder_panics(which in any::<Index>(), mutations in vec(mutation(), 1..6)) {
        thread_local!(static FRAMES: Vec<Vec<u8>> = frames());
        let mut frame = FRAMES.with(|frames| which.get(frames).clone());
        mutations.iter().for_each(|mutation| mutation.apply(&mut frame));
        decode_as::<Snapshot>(&frame);
        decode_as::<JobRequest>(&frame);
        decode_as::<JobReply>(&frame);
        decode_as::<ScoreReport>(&frame);
        decode_as::<ScoreReply>(&frame);
        decode_as::<RecordedScores>(&frame);
        decode_as::<Progress>(&frame);
        decode_as::<WeightsRequest>(&frame);
    }
}
