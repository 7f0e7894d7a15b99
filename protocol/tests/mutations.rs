//! Messages with some bytes changed: every decoder gives a message or an error, and never panics.
//! What comes out is the same message when it is sent on.
//!
//! `QUAD_MUTATIONS=1000000 cargo test --release --workspace --test mutations` tries as many.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod frames;

use frames::{decode_as_each, frames};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::sample::Index;

/// So many without the variable: a second or two.
const MUTATIONS: u32 = 200_000;

fn mutations() -> u32 {
    std::env::var("QUAD_MUTATIONS")
        .ok()
        .map_or(MUTATIONS, |text| text.parse().expect("QUAD_MUTATIONS is a number"))
}

/// From a place on, so many bytes make way for others: a few, or a number of eight, which may be
/// taken for a length.
fn mutation() -> impl Strategy<Value = (Index, usize, Vec<u8>)> {
    let length = prop_oneof![
        any::<u64>(),
        Just(u64::MAX),
        Just(0),
        0_u64..300,
        Just(1 << 32),
        Just(1 << 20)
    ];
    let eight = length.prop_map(|length| (8, length.to_le_bytes().to_vec()));
    let few = (0_usize..20, vec(any::<u8>(), 0..20));
    let one = any::<u8>().prop_map(|byte| (1, vec![byte]));
    (any::<Index>(), prop_oneof![eight, few, one])
        .prop_map(|(at, (removed, bytes))| (at, removed, bytes))
}

proptest! {
    #![proptest_config(ProptestConfig { cases: mutations(), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn no_decoder_panics(which in any::<Index>(), mutations in vec(mutation(), 1..6)) {
        thread_local!(static FRAMES: Vec<Vec<u8>> = frames());
        let mut frame = FRAMES.with(|frames| which.get(frames).clone());
        for (at, removed, bytes) in mutations {
            let at = at.index(frame.len() + 1);
            drop(frame.splice(at..(at + removed).min(frame.len()), bytes));
        }
        decode_as_each(&frame);
    }
}
