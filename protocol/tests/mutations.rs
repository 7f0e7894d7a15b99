//! Messages with some bytes changed: every decoder gives a message or an error, and never panics. What comes out is the same
//! message when it is sent on.
//!
//! `QUAD_MUTATIONS=1000000 cargo test --release --workspace --test mutations` tries as many.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod frames;

use frames::frames;
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::Index;
use quad_protocol::*;

/// So many without the variable: a second or two.
const MUTATIONS: u32 = 200_000;

fn mutations() -> u32 {
    std::env::var("QUAD_MUTATIONS").ok().map_or(MUTATIONS, |text| text.parse().expect("QUAD_MUTATIONS is a number"))
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
        decode_as::<Progress>(&frame);
    }
}
